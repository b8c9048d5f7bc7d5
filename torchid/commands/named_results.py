"""Identified parameters by the name of a body or joint, and as rows of a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from torchid import parameters
from torchid.errors import UnknownNameError, format_count
from torchid.estimators import Estimate
from torchid.parameters import PARAMETER_UNITS, PARAMETERS, PER_BODY, Array
from torchid.problem.metrics import DECISIVE_GROUPS, describe_errors, describe_worse
from torchid.report.tables import table_text
from torchid.reprs import decimal
from torchid.robot import Robot

if TYPE_CHECKING:
    from torchid.commands.results import Identification

_FEW_ROWS, _WIDTH = 8, 108


class _OfBody:
    """Twelve values of a body, (12,), by the names of its parameters."""

    _values: NDArray[Any]

    def __getitem__(self, parameter: str) -> Any:
        """The value of a parameter by its symbol, as in `parameters.json`: m, mcx, ..., Ixx, ..., fc, fv.

        Raises:
            UnknownNameError: there is no such parameter.
        """
        if parameter not in PARAMETERS:
            raise UnknownNameError("", "parameter", str(parameter), PARAMETERS)
        return self._values[PARAMETERS.index(parameter)].item()

    def to_dict(self) -> dict[str, Any]:
        return dict(zip(PARAMETERS, self._values.tolist(), strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class BodyValues(_OfBody):
    """Parameters of one body in its link frame, or their standard errors (NaN where the data determine none)."""

    _values: Array

    @property
    def mass(self) -> float:
        """[kg]."""
        return float(self._values[parameters.MASS])

    @property
    def first_moment(self) -> Array:
        """Mass times centre of mass, (3,) [kg m]."""
        return self._values[parameters.FIRST_MOMENT].copy()

    @property
    def inertia(self) -> Array:
        """Rotational inertia about the link frame's origin, (3, 3) [kg m^2]."""
        return parameters.inertia_matrix(self._values)

    @property
    def coulomb_friction(self) -> float:
        """Of the joint that moves the body, [N m], or [N] of a prismatic one."""
        return float(self._values[parameters.COULOMB])

    @property
    def viscous_friction(self) -> float:
        """Of the joint that moves the body, [N m s/rad], or [N s/m] of a prismatic one."""
        return float(self._values[parameters.VISCOUS])

    def __repr__(self) -> str:
        return "\n".join(f"{name:4}{value: .6g} {unit}" for name, value, unit in self._lines())

    def _lines(self) -> Iterator[tuple[str, float, str]]:
        """Inertia in two lines would be read as a matrix; mass, moments and friction are what is looked for first."""
        for name in ("m", "mcx", "mcy", "mcz", "Ixx", "Iyy", "Izz", "fc", "fv"):
            yield name, self[name], PARAMETER_UNITS[PARAMETERS.index(name)]


@dataclass(frozen=True, eq=False, repr=False)
class BodyVerdicts(_OfBody):
    """How far the data determine the parameters of one body, see `Estimate.verdict`."""

    _values: NDArray[np.str_]

    @property
    def mass(self) -> str:
        """Of the mass."""
        return str(self._values[parameters.MASS])

    @property
    def first_moment(self) -> tuple[str, ...]:
        """Of mass times centre of mass, three."""
        return tuple(self._values[parameters.FIRST_MOMENT].tolist())

    @property
    def inertia(self) -> tuple[str, ...]:
        """Of Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""
        return tuple(self._values[parameters.INERTIA].tolist())

    @property
    def coulomb_friction(self) -> str:
        """Of Coulomb friction."""
        return str(self._values[parameters.COULOMB])

    @property
    def viscous_friction(self) -> str:
        """Of viscous friction."""
        return str(self._values[parameters.VISCOUS])

    def __repr__(self) -> str:
        by_verdict: dict[str, list[str]] = {}
        for name, verdict in self.to_dict().items():
            by_verdict.setdefault(verdict, []).append(name)
        return "\n".join(f"{verdict}: {', '.join(names)}" for verdict, names in by_verdict.items())


@dataclass(frozen=True, eq=False, repr=False)
class BodyEstimate(BodyValues):
    """Identified parameters of one body, with the URDF's, standard errors and verdicts under the same names.

    Attributes:
        name: of the body, that of its link.
        joint: that moves it, "" for the base.
        nominal: the URDF's parameters.
        standard_error: of the identified ones, NaN where the data do not determine them.
        verdict: how far the data determine them.
    """

    name: str = field(kw_only=True)
    joint: str = field(kw_only=True)
    nominal: BodyValues = field(kw_only=True)
    standard_error: BodyValues = field(kw_only=True)
    verdict: BodyVerdicts = field(kw_only=True)

    @property
    def center_of_mass(self) -> Array:
        """In the link frame, (3,) [m]; NaN without mass."""
        return self.first_moment / self.mass if self.mass else np.full(3, np.nan)

    def __repr__(self) -> str:
        moved = f", moved by {self.joint}" if self.joint else ""
        lines = [f"{self.name}{moved}: identified (nominal) ± standard error, verdict"]
        for name, value, unit in self._lines():
            error = self.standard_error[name]
            known = f" ± {error:.2g}" if np.isfinite(error) else ""
            lines.append(f"{name:4}{value: .5g} ({self.nominal[name]:.5g}){known} {unit}, {self.verdict[name]}")
        return "\n".join(lines)


def body_estimate(robot: Robot, estimate: Estimate, name: str) -> BodyEstimate:
    """What an estimate says of a body, by its name, or else by that of its joint or of any link of it.

    Raises:
        UnknownNameError: the robot has neither.
    """
    joints = {body.joint.name: number for number, body in enumerate(robot.bodies) if body.joint is not None}
    numbers = {link: number for link, (number, _) in robot.links.items()} | joints
    numbers |= {body: number for number, body in enumerate(robot.body_names)}
    if name not in numbers:
        raise UnknownNameError("", "body or joint", str(name), (*robot.body_names, *joints))
    number = numbers[name]
    phi, error, verdict = (
        x.reshape(-1, PER_BODY)[number] for x in (estimate.phi, estimate.standard_error, estimate.verdict)
    )
    joint = robot.bodies[number].joint
    return BodyEstimate(
        phi,
        name=robot.body_names[number],
        joint="" if joint is None else joint.name,
        nominal=BodyValues(robot.nominal[number]),
        standard_error=BodyValues(error),
        verdict=BodyVerdicts(verdict),
    )


def run_lines(run: Identification) -> list[str]:
    """What a run is and found, in at most ten lines."""
    robot, estimate, config = run.experiment.robot, run.estimate, run.experiment.config
    counts = ", ".join(f"{count} {verdict}" for verdict, count in estimate.verdict_counts().items() if count)
    said = [("data", f"{format_count(run.samples, 'sample')} of {format_count(len(config.logs.train), 'log')}")]
    said += [("parameters", f"{estimate.phi.size}: {counts}")]
    if not robot.fixed_base:
        said.append(("total mass", f"{run.mass} ({robot.format}: {decimal(run.mass.nominal)} kg)"))
    sets = {name: (pair.identified, pair.nominal) for name, pair in run.metrics.items()}
    if run.validation is not None:
        sets["left out"] = (run.validation.identified, run.validation.nominal)
    for name, (identified, nominal) in sets.items():
        texts = (describe_errors(group, identified.rms_of(group), nominal.rms_of(group)) for group in DECISIVE_GROUPS)
        said.append((name, "; ".join(filter(None, texts))))
    trouble = [
        *([f"WORSE THAN {robot.format}: {describe_worse(run.worse, robot.format)}"] if run.worse else []),
        str(run.misfit),
    ]
    said += [("attention", "; ".join(filter(None, trouble)))] if any(trouble) else []
    said.append(("written to", str(config.output or "no folder: write(folder), to_urdf(file)")))
    of = f"{robot.path.name}, {len(run)} bodies, {format_count(robot.n, 'joint')}, by {config.estimator.name}"
    lines = (f"{label:12}{shorten(text, _WIDTH, placeholder=' ...')}" for label, text in said)
    return [f"Identification of {of}", *lines]


class ParameterTable(list[dict[str, Any]]):
    """Rows of a table, one for each parameter of each body: mappings with the same keys, as `pandas.DataFrame` takes.

    `print` shows all of it.
    """

    def __str__(self) -> str:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for key in self[0] if self else ():
            table.add_column(key, no_wrap=True, justify="right" if isinstance(self[0][key], float) else "left")
        for row in self:
            table.add_row(*(Text(f"{x:.5g}" if isinstance(x, float) else str(x)) for x in row.values()))
        return "\n".join(line.rstrip() for line in table_text(table, 200).splitlines())

    def __repr__(self) -> str:
        if len(self) <= _FEW_ROWS:
            return str(self)
        return f"{ParameterTable(self[:_FEW_ROWS])}\n... {len(self)} rows; print() shows all"


def parameter_table(robot: Robot, estimate: Estimate) -> ParameterTable:
    """All parameters with the URDF's, standard errors and verdicts."""
    rows = ParameterTable()
    for name in robot.body_names:
        body = body_estimate(robot, estimate, name)
        for parameter, unit in zip(PARAMETERS, PARAMETER_UNITS, strict=True):
            rows.append(
                {
                    "body": name,
                    "parameter": parameter,
                    "unit": unit,
                    "urdf": body.nominal[parameter],
                    "identified": body[parameter],
                    "standard_error": body.standard_error[parameter],
                    "verdict": body.verdict[parameter],
                }
            )
    return rows
