"""What an identification finds: its numbers, by the names of bodies and joints, and as rows of a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from torchid import parameters
from torchid.commands.chosen_settings import Choices
from torchid.errors import UnknownNameError
from torchid.estimators import Estimate, Violation
from torchid.fitting.experiment import Experiment
from torchid.fitting.factor_files import FactorFile
from torchid.fitting.fit import Comparison
from torchid.fitting.left_out import CrossValidation, RidgeChoice
from torchid.fitting.noise import Misfit, NoiseSummary
from torchid.fitting.posterior import FittedPosterior
from torchid.fitting.robust import RobustSummary
from torchid.identifiability.base_parameters import StateReport
from torchid.identifiability.confounding import ExtraEstimate, TotalMass
from torchid.identifiability.information import Contributions
from torchid.parameters import PARAMETER_UNITS, PARAMETERS, PER_BODY, Array
from torchid.problem import Metrics
from torchid.problem.metrics import WorseThanNominal, worse_than_nominal
from torchid.problem.noise_gram import NoiseShares
from torchid.report import FittedJoints
from torchid.report.forces import ForceSeries
from torchid.report.robot_files import refused_by_simulators
from torchid.report.tables import table_text
from torchid.robot import Robot

HELD_OUT = "blocks left out of the fit"
"""Name of the training samples that cross-validation predicts, in messages."""
_FEW_ROWS = 8


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
    """Identified parameters of one body; nominal values, standard errors and verdicts have the same names.

    Attributes:
        name: of the body (its link).
        joint: the joint that moves it, "" for the base.
        nominal: parameters of the URDF.
        standard_error: of the identified values; NaN where the data do not determine them.
        verdict: how far the data determine them.
    """

    name: str = field(kw_only=True)
    joint: str = field(kw_only=True)
    nominal: BodyValues = field(kw_only=True)
    standard_error: BodyValues = field(kw_only=True)
    verdict: BodyVerdicts = field(kw_only=True)

    @property
    def center_of_mass(self) -> Array:
        """Centre of mass in the link frame, (3,) [m]; NaN without mass."""
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


class ParameterTable(list[dict[str, Any]]):
    """Table with one row per parameter of each body: a list of mappings, as `pandas.DataFrame` takes it.

    `print` shows the whole table.
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


@dataclass(frozen=True, kw_only=True, repr=False)
class Results:
    """What a run has found; `run["l_knee"]` is what it says of a body, by its name or that of its joint.

    Attributes:
        experiment: robot, contacts, sensors and settings, with the noise and the ridge that were used.
        estimate: the fit.
        extras: offsets, scales and actuator terms.
        noise: that rows were weighted with.
        motion_noise: what noise of the motion had added to the normal equations.
        misfit: what the fit leaves of the forces, and what noise would leave.
        resting: share of the time at rest of joints that rest often, where friction goes with the sign of velocities or
            torques then count as unmeasured.
        at_rest: sets of logs, "train" and "test", in which nothing moves.
        robust: how outliers were down-weighted, if so.
        states: contact states of the training logs.
        by_state: what each of them determines on its own.
        contributions: what each training log, contact state and sensor adds.
        metrics: errors by set of logs, "train" and "test".
        evaluated: number of samples whose forces were predicted, by set of logs.
        violations: conditions that the identified parameters break.
        seconds: by step of the run.
        samples: number of training samples.
        factors: the training logs, where they came compressed.
        excluded: rejected samples left out, by log.
        mass: the total mass and how well it is known.
        posterior: of the parameters, which `PosteriorSampler` draws from.
        validation: errors on held-out blocks, None where the samples are too few to leave some out.
        ridge: how it was chosen, if it was.
        choices: how other settings were chosen, if they were.
        forces: of a log, as measured and as predicted; None where there are but factors.
        suspected: what the checks find in its training logs if it is doubtful, in words.
    """

    experiment: Experiment
    estimate: Estimate
    extras: list[ExtraEstimate]
    noise: NoiseSummary
    motion_noise: NoiseShares
    misfit: Misfit
    resting: Mapping[str, float]
    at_rest: Sequence[str]
    robust: RobustSummary | None
    states: list[StateReport]
    by_state: dict[str, Estimate]
    contributions: Contributions
    metrics: dict[str, Comparison[Metrics]]
    evaluated: Mapping[str, int]
    violations: list[Violation]
    seconds: dict[str, float]
    samples: int
    factors: Sequence[FactorFile]
    excluded: Mapping[str, int]
    mass: TotalMass
    posterior: FittedPosterior
    validation: CrossValidation | None
    ridge: RidgeChoice | None
    choices: Choices
    forces: ForceSeries | None
    suspected: str = ""

    def __getitem__(self, name: str) -> BodyEstimate:
        """Identified parameters of a body, by its name, or else by that of its joint or of any link of it.

        Raises:
            UnknownNameError: the robot has neither.
        """
        return body_estimate(self.experiment.robot, self.estimate, name)

    def __iter__(self) -> Iterator[str]:
        """Names of the bodies."""
        return iter(self.experiment.robot.body_names)

    def __len__(self) -> int:
        """Number of bodies."""
        return len(self.experiment.robot.bodies)

    def table(self) -> ParameterTable:
        """All parameters of all bodies, one per row; `pandas.DataFrame` takes it."""
        return parameter_table(self.experiment.robot, self.estimate)

    def violations_by_name(self) -> list[dict[str, object]]:
        """Conditions that the identified parameters break, the body by its name."""
        names = self.experiment.robot.body_names
        return [asdict(x) | {"body": None if x.body is None else names[x.body]} for x in self.violations]

    @cached_property
    def worse(self) -> list[WorseThanNominal]:
        """Groups of rows where the URDF predicts better, on blocks left out of the fit or on the test logs."""
        sets = {} if self.validation is None else {HELD_OUT: (self.validation.nominal, self.validation.identified)}
        return worse_than_nominal(sets | ({"test logs": self.metrics["test"]} if "test" in self.metrics else {}))

    def state_entries(self) -> list[dict[str, object]]:
        """Contact states, with what each of them adds."""
        contributions = {state.name: asdict(state) for state in self.contributions.states}
        return [asdict(state) | contributions[state.name] for state in self.states]

    @property
    def fitted_joints(self) -> FittedJoints:
        """What was fitted of joints beside friction."""
        return FittedJoints.of((x.extra, x.value) for x in self.extras)

    @cached_property
    def refused(self) -> str:
        """Why simulators refuse the robot's file with the identified parameters, "" if they take it."""
        return refused_by_simulators(self.experiment.robot, self.phi, self.fitted_joints)

    @property
    def phi(self) -> Array:
        """Identified parameters, (L, 12)."""
        return self.estimate.phi.reshape(-1, PER_BODY)
