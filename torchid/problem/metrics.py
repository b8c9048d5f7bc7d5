"""Errors of predicted forces, by group of rows, and where they are worse than the nominal model's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from torchid.errors import format_percent, join_names
from torchid.parameters import GRAVITY, MASS, Array
from torchid.problem.chunk_dynamics import ChunkKinematics
from torchid.problem.chunks import ProgressCallback, map_chunks
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import ExtraTerms
from torchid.problem.predict import (
    measured_and_predicted_forces,
    null_space_components,
    pressure_centres,
    reading_variance,
)
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, named_sensors


class SumsOfSquares:
    """Sums and sums of squares by row, over the samples in which the row is finite."""

    def __init__(self, rows: int) -> None:
        self.sum, self.squares, self.count = np.zeros(rows), np.zeros(rows), np.zeros(rows)

    def add(self, x: torch.Tensor, weight: float = 1.0) -> None:
        """Add samples (N, rows), NaN where unknown, each of which counts as `weight` samples."""
        values = x.cpu().numpy()
        known = np.isfinite(values)
        if not known.all():
            values = np.where(known, values, 0.0)
        self.sum += weight * values.sum(0)
        self.squares += weight * np.einsum("ij,ij->j", values, values)
        self.count += weight * known.sum(0)

    def add_squares(self, squares: float, count: int) -> None:
        """Add the sum of squares of one row over `count` samples; their sum stays unknown."""
        self.squares += squares
        self.count += count

    def rms(self, rows: slice = slice(None)) -> Array:
        """Rms row by row, (n_rows,) [N or N m]."""
        return root_mean(self.squares[rows], self.count[rows])

    def pooled(self, rows: slice) -> float:
        """Rms over all components of some rows."""
        count = self.count[rows].sum()
        return float(np.sqrt(self.squares[rows].sum() / count)) if count else np.nan

    def deviation(self, rows: slice) -> float:
        """Rms about the mean of each row, over all of them."""
        known = self.count[rows] > 0
        count, total = self.count[rows][known], self.sum[rows][known]
        if not len(count):
            return np.nan
        return float(np.sqrt(max((self.squares[rows][known] - total**2 / count).sum(), 0.0) / count.sum()))

    def merge(self, other: SumsOfSquares) -> None:
        """Add the sums of another."""
        self.sum += other.sum
        self.squares += other.squares
        self.count += other.count


def root_mean(squares: Array, count: Array) -> Array:
    """Square root of a mean, NaN of nothing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(squares / count)


WHITENED = "projected_residual"
"""The group of the rows of a fit: whitened, and projected so that nothing unmeasured is in them."""

ROW_GROUPS = {
    "joint_torque": "joint torque [N m]",
    "base_force": "base force [N]",
    "base_moment": "base moment [N m]",
    "nullspace": "projected [N, N m]",
}
"""Groups of rows that errors are given for, with a name and unit to show."""

ERROR_GROUPS = ROW_GROUPS | {WHITENED: "whitened [x noise]"}
"""Those, and the whitened projected residual of a fit's rows, which every sensor set has."""

IN_AIR = "limbs in the air"  # whose joint torques alone count where no contact force was measured

LIMB_GROUPS = {"ft_force": "force in limbs [N]", "ft_moment": "moment in limbs [N m]"}
"""Groups of readings of force/torque sensors in limbs."""

PRESSURE = "centre_of_pressure"
PRESSURE_GROUP = {PRESSURE: "centre of pressure [m]"}
"""The point where the ground's forces meet the ground, where they carry a tenth of the weight or more."""

_LABELS = ERROR_GROUPS | LIMB_GROUPS | PRESSURE_GROUP

LOG_SETS = ("train", "test")
"""Sets of logs that errors are given for."""

BASE_ROWS = tuple(f"base {kind} {axis}" for kind in ("force", "moment") for axis in "xyz")
"""Names of the six base rows."""

DECISIVE_GROUPS = ("joint_torque", "base_force", "base_moment", *LIMB_GROUPS, WHITENED)
"""Groups of rows by which parameters are compared with the nominal ones."""

ADVICE = (
    "do not use them before you know why: run torchid check on the same file, set a larger estimator.ridge than "
    "that of its config.yaml, or record more and other motion"
)
"""Advice for parameters that predict worse than the nominal ones."""

_CARRIES = 0.1  # of the weight in the robot's file: with less force on the ground its point says nothing
_NOISE_SAMPLES = 64  # of a chunk, for the noise of its measured forces
_CLEARLY = 1.05  # ratio of errors above which one is worse
_MATTERS = 1e-3  # of the measured rms: smaller differences, as on data without noise, do not count


@dataclass(frozen=True, repr=False)
class Metrics:
    """Errors of one parameter vector on some logs; None where the logs cannot give a figure.

    `rms` and `relative` by group of `ERROR_GROUPS`, the last in units of the stated noise, `rms` also of `PRESSURE`
    where contact forces are measured and carry a tenth of the weight; `by_joint_rms` and
    `by_joint_relative` by joint. Relative means rms of the error over
    rms of what was measured. `rms` of "joint_torque" is the mean over joints of their rms, relative to the same mean of
    the measured. `base_force_of_variation` is relative to the rms of the measured base force about its mean, which is
    mostly weight. `limb_rms` and `limb_relative` by `LIMB_GROUPS`, empty for a robot without sensors in limbs.
    `by_axis_rms` and `by_axis_relative` of forces and moments by group and axis: of the base link, or of a sensor's
    frame, all sensors in limbs together. `noise`, by group, is the rms that the stated noise of the readings leaves
    after the filter, which no model predicts; None where it is not known. `limbs_in_air`: joint torques are those of
    limbs in the air alone, as no contact force was measured.
    """

    rms: dict[str, float | None]
    relative: dict[str, float | None]
    by_joint_rms: dict[str, float | None]
    by_joint_relative: dict[str, float | None]
    base_force_of_variation: float | None
    limb_rms: dict[str, float | None] = field(default_factory=dict)
    limb_relative: dict[str, float | None] = field(default_factory=dict)
    by_axis_rms: dict[str, dict[str, float | None]] = field(default_factory=dict)
    by_axis_relative: dict[str, dict[str, float | None]] = field(default_factory=dict)
    noise: dict[str, float | None] = field(default_factory=dict)
    limbs_in_air: bool = False

    def rms_of(self, group: str) -> float | None:
        """Rms error of a group of `ERROR_GROUPS` or `LIMB_GROUPS`."""
        return self.rms.get(group, self.limb_rms.get(group))

    def relative_of(self, group: str) -> float | None:
        """The same, over the rms of what was measured."""
        return self.relative.get(group, self.limb_relative.get(group))

    def label(self, group: str) -> str:
        """Name and unit of such a group, and what it is limited to."""
        limit = f", {IN_AIR} [" if self.limbs_in_air and group == "joint_torque" else " ["
        return _LABELS[group].replace(" [", limit)

    def __repr__(self) -> str:
        said = []
        for group in ERROR_GROUPS:
            rms, share = self.rms.get(group), self.relative.get(group)
            if rms is not None:
                name, _, unit = self.label(group).rstrip("]").partition(" [")
                said.append(f"{name} {rms:.3g} {unit}" + ("" if share is None else f" ({format_percent(share)} %)"))
        return f"Metrics: {', '.join(said) or 'none'}"

    def as_dict(self) -> dict[str, object]:
        """As `metrics.json` has it."""
        out: dict[str, object] = {}
        for suffix, groups, joints, limbs, axes in (
            ("rms", self.rms, self.by_joint_rms, self.limb_rms, self.by_axis_rms),
            ("rms_relative", self.relative, self.by_joint_relative, self.limb_relative, self.by_axis_relative),
        ):
            out |= {f"{group}_{suffix}": x for group, x in limbs.items()}
            out |= {f"{group}_{suffix.replace('rms', 'rms_by_axis')}": x for group, x in axes.items()}
            for group in ROW_GROUPS:
                out[f"{group}_{suffix}"] = groups[group]
                if group == "joint_torque":
                    out[f"joint_torque_{suffix.replace('rms', 'rms_by_joint')}"] = joints
        out[f"{PRESSURE}_rms"] = self.rms.get(PRESSURE)
        return out | {WHITENED: self.rms.get(WHITENED), f"{WHITENED}_relative": self.relative.get(WHITENED)}


class Evaluation:
    """Evaluates several parameter vectors at once, in one pass over the logs."""

    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        device: str = "cpu",
        terms: ExtraTerms | None = None,
        noise: SensorNoise | None = None,
    ) -> None:
        """Set robot, contacts and actuator terms; all recorded sensors of a log are used.

        `noise`: standard deviations of readings as recorded, NaN where unknown, to compare errors with.
        """
        actuators = replace(terms or ExtraTerms(), offsets={}, scales={})
        self.robot, self.noise = robot, noise
        sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
        self.builder = RowBuilder(robot, contacts, sensors, actuators).to(device)

    @property
    def least_carried(self) -> float:
        """Force on the ground from which on it has a centre of pressure [N]."""
        return _CARRIES * GRAVITY * float(self.robot.nominal[:, MASS].sum())

    def metrics(self, logs: Sequence[Samples], phi: Array, progress: ProgressCallback | None = None) -> list[Metrics]:
        """One `Metrics` per row of `phi` (M, 12 L), over all samples of the logs together.

        Without the whitened projected residual, which depends on sensors.
        """
        measured, *errors = self.force_sums(logs, {log.fold: phi for log in logs} or {0: phi}, progress)
        return [self.summarize(measured, error) for error in errors]

    def force_sums(
        self, logs: Sequence[Samples], phi: Mapping[int, Array], progress: ProgressCallback | None = None
    ) -> list[ForceSums]:
        """Sums of squares of the measured forces, then of the errors of each row of `phi` (M, 12 L) of a log's fold."""
        builder, base = self.builder, self.robot.base_rows
        columns = {fold: builder.to_columns(own) for fold, own in phi.items()}
        count, joints = 1 + len(next(iter(phi.values()))), slice(base, base + self.robot.n)

        def sum_chunks(chunks: Iterator[tuple[Samples, ContactState]]) -> list[ForceSums]:
            sums = [ForceSums(self.robot.n_rows) for _ in range(count)]
            for samples, state in chunks:
                kinematics = builder.kinematics(samples)
                forces = measured_and_predicted_forces(builder, samples, state, columns, kinematics)
                sums[0].add_contact_forces(forces.measured[:, joints], forces.torque[:, joints])
                errors = torch.cat([-forces.measured[None], forces.predicted - forces.measured])
                errors = kinematics.without_rest(errors, base)
                for total, error in zip(sums, builder.motors.of(builder.tree, kinematics, errors), strict=True):
                    total.rows.add(error)
                if base:
                    wrench = torch.cat([forces.measured[None], forces.predicted])[..., :base]
                    at = pressure_centres(builder, samples, state, kinematics, wrench, self.least_carried)
                    for total, off in zip(sums[1:], torch.linalg.vector_norm(at[1:] - at[0], dim=-1), strict=True):
                        total.pressure.add(off[:, None])
                vectors = torch.cat([forces.torque[None], forces.predicted - forces.torque])
                if self.noise is not None:
                    sums[0].noise.merge(self._noise_sums(samples, state, kinematics, self.noise))
                for group in null_space_components(builder, state, kinematics, vectors):
                    for total, inside in zip(sums, group, strict=True):
                        total.projected.add(inside.flatten()[:, None])
            return sums

        loaded = [replace(log, unloaded=None) for log in logs]
        parts = map_chunks(loaded, builder, sum_chunks, progress=progress)
        return [ForceSums.total(same) for same in zip(*parts, strict=True)]

    def _noise_sums(
        self, samples: Samples, state: ContactState, kinematics: ChunkKinematics, noise: SensorNoise
    ) -> SumsOfSquares:
        """Sums of the variances of the measured forces, from some samples of a chunk: they hardly change."""
        sums, step = SumsOfSquares(self.robot.n_rows), -(-len(samples) // _NOISE_SAMPLES)
        part = samples.every(step)
        variance = reading_variance(self.builder, part, state, kinematics.some(slice(None, None, step)), noise)
        sums.add(variance.sqrt(), len(samples) / len(part))
        return sums

    def summarize(self, measured: ForceSums, errors: ForceSums) -> Metrics:
        """Metrics from sums of squares."""
        base, n = self.robot.base_rows, self.robot.n
        rms, size = errors.rms(base, n), measured.rms(base, n)
        pressure = finite_or_none(errors.pressure.pooled(slice(None)))
        joints = slice(base, base + n)
        by_joint, joint_size = errors.rows.rms(joints), measured.rows.rms(joints)
        groups = ERROR_GROUPS if errors.whitened.count.any() else ROW_GROUPS
        names, limbs = self.robot.joint_names, LIMB_GROUPS if self.robot.ft_names else {}
        axes, axis_size = errors.rows_by_axis(base, n), measured.rows_by_axis(base, n)
        return Metrics(
            {group: finite_or_none(rms[group]) for group in groups} | ({PRESSURE: pressure} if pressure else {}),
            {group: _ratio(rms[group], size[group]) for group in groups},
            {name: finite_or_none(x) for name, x in zip(names, by_joint, strict=True)},
            {name: _ratio(x, y) for name, x, y in zip(names, by_joint, joint_size, strict=True)},
            _ratio(rms["base_force"], measured.rows.deviation(slice(0, 3)) if base else np.nan),
            {group: finite_or_none(rms[group]) for group in limbs},
            {group: _ratio(rms[group], size[group]) for group in limbs},
            {group: dict(zip("xyz", map(finite_or_none, x), strict=True)) for group, x in axes.items()},
            {group: dict(zip("xyz", map(_ratio, x, axis_size[group]), strict=True)) for group, x in axes.items()},
            {} if self.noise is None else measured.noise_rms(base, n),
            bool(measured.contact_forces[0] and not measured.contact_forces[1]),
        )


def compare_parts(nominal: Metrics, identified: Metrics) -> tuple[int, int, list[str]]:
    """Of joints and axes of the base: how many are predicted better, of how many, and those that are clearly worse."""
    pairs = {
        name: (before, identified.by_joint_rms.get(name), identified.by_joint_relative.get(name))
        for name, before in nominal.by_joint_rms.items()
    }
    for group in ("base_force", "base_moment"):
        after, share = identified.by_axis_rms.get(group, {}), identified.by_axis_relative.get(group, {})
        for axis, before in nominal.by_axis_rms.get(group, {}).items():
            pairs[f"{group_name(group)} {axis}"] = before, after.get(axis), share.get(axis)
    known = {name: (x, y, share) for name, (x, y, share) in pairs.items() if x is not None and y is not None}
    worse = [f"{name} ({y / x:.2g} times)" for name, (x, y, share) in known.items() if x and _is_worse(x, y, share)]
    return sum(y < x for x, y, _ in known.values()), len(known), worse


def _is_worse(before: float, after: float, share: float | None) -> bool:
    """Whether an error is clearly larger than before; `share`: of the measured, of the one after."""
    return after > _CLEARLY * before and after - before > _MATTERS * (after / share if share else 0.0)


def worse_than_nominal(sets: Mapping[str, tuple[Metrics, Metrics]]) -> list[WorseThanNominal]:
    """Groups of rows where identified parameters are clearly worse; `sets`: nominal and identified metrics by logs."""
    worse = []
    for logs, (nominal, identified) in sets.items():
        for group in DECISIVE_GROUPS:
            before, after = nominal.rms_of(group), identified.rms_of(group)
            if before is None or after is None:
                continue
            if _is_worse(before, after, identified.relative_of(group)):
                worse.append(WorseThanNominal(logs, group, before, after))
    return worse


@dataclass(frozen=True)
class WorseThanNominal:
    """A group of rows on a set of logs in which the nominal parameters predict better, with both errors."""

    logs: str
    group: str
    nominal: float
    identified: float

    def __str__(self) -> str:
        return describe_errors(self.group, self.identified, self.nominal) or self.group


def describe_worse(groups: list[WorseThanNominal], of: str) -> str | None:
    """One line that lists the groups, None if there are none.

    `of`: what the nominal parameters are those of, as `Robot.format`.
    """
    if not groups:
        return None
    by_logs = {group.logs: [str(other) for other in groups if other.logs == group.logs] for group in groups}
    texts_by_logs = "; ".join(f"on {logs}: {join_names(texts)}" for logs, texts in by_logs.items())
    return f"the identified parameters predict worse than the {of}'s, {texts_by_logs}"


def describe_errors(group: str, identified: float | None, nominal: float | None) -> str | None:
    """Both errors of a group of rows in words, None where it has none."""
    if identified is None or nominal is None:
        return None
    unit = _LABELS[group].split("[")[1].rstrip("]")
    name = "whitened projected residual" if group == WHITENED else group_name(group)
    return f"{name} {identified:.3g} against {nominal:.3g} {unit}"


def group_name(group: str) -> str:
    """Name of a group of rows, without its unit."""
    return _LABELS[group].split(" [")[0]


class ForceSums:
    """Sums of squares of generalized forces or their errors: of rows, and inside the contacts' null space.

    `whitened`: of the rows of a fit, V_x^T f of its sensors in units of their noise. `noise` of rows: what the noise of
    readings adds to the measured forces; `whitened_noise`: to the rows of a fit. `pressure`: distances of centres of
    pressure. `contact_forces`: whether one
    that was not measured enters joint rows, which do not count, and whether a measured one enters rows that do.
    """

    def __init__(self, n_rows: int) -> None:
        self.rows, self.projected, self.whitened = SumsOfSquares(n_rows), SumsOfSquares(1), SumsOfSquares(1)
        self.noise, self.whitened_noise = SumsOfSquares(n_rows), SumsOfSquares(1)
        self.pressure = SumsOfSquares(1)
        self.contact_forces = np.zeros(2, dtype=bool)

    @classmethod
    def total(cls, parts: Sequence[ForceSums]) -> ForceSums:
        """Sums over all parts."""
        out = cls(len(parts[0].rows.squares))
        for part in parts:
            for name in ("rows", "projected", "whitened", "noise", "whitened_noise", "pressure"):
                getattr(out, name).merge(getattr(part, name))
            out.contact_forces |= part.contact_forces
        return out

    def add_contact_forces(self, measured: torch.Tensor, torque: torch.Tensor) -> None:
        """Note those in measured joint rows J_C^T lambda + tau, (B, n), NaN where one is not known."""
        lost, known = measured.isnan() & torque.isfinite(), measured.isfinite() & (measured != torque)
        self.contact_forces |= [bool(lost.any()), bool(known.any())]

    def noise_rms(self, base_rows: int, n: int) -> dict[str, float | None]:
        """Rms of the noise by group of rows, as `rms`; None where it is not known."""
        by_group = _by_group(self.noise, base_rows, n) | {WHITENED: self.whitened_noise.pooled(slice(None))}
        return {group: finite_or_none(x) for group, x in by_group.items()}

    def rms(self, base_rows: int, n: int) -> dict[str, float]:
        """Rms by group of rows, NaN for an empty group, of a robot with `base_rows` and n joints."""
        squares, count = self._in_limbs(base_rows + n)
        force, moment = root_mean(squares.sum(1), count.sum(1))
        return _by_group(self.rows, base_rows, n) | {
            "ft_force": float(force),
            "ft_moment": float(moment),
            "nullspace": self.projected.pooled(slice(None)),
            WHITENED: self.whitened.pooled(slice(None)),
        }

    def rows_by_axis(self, base_rows: int, n: int) -> dict[str, Array]:
        """Rms of forces and moments of the base, and of force/torque sensors in limbs, (3,) by group of rows."""
        out = dict(zip(("base_force", "base_moment"), self.rows.rms(slice(0, base_rows)).reshape(-1, 3), strict=False))
        squares, count = self._in_limbs(base_rows + n)
        if len(self.rows.count) > base_rows + n:
            out |= dict(zip(LIMB_GROUPS, root_mean(squares, count), strict=True))
        return out

    def _in_limbs(self, first: int) -> tuple[Array, Array]:
        """Squares and their number, (2, 3): forces and moments by axis, of all force/torque sensors in limbs."""
        squares, count = (x[first:].reshape(-1, 2, 3).sum(0) for x in (self.rows.squares, self.rows.count))
        return squares, count


def _by_group(sums: SumsOfSquares, base_rows: int, n: int) -> dict[str, float]:
    joints = sums.rms(slice(base_rows, base_rows + n))
    return {
        "joint_torque": float(np.nanmean(joints)) if np.isfinite(joints).any() else np.nan,
        "base_force": sums.pooled(slice(0, 3)) if base_rows else np.nan,
        "base_moment": sums.pooled(slice(3, 6)) if base_rows else np.nan,
    }


def finite_or_none(x: float) -> float | None:
    """A number, or None where there is none."""
    return float(x) if np.isfinite(x) else None


def _ratio(x: float, y: float) -> float | None:
    return float(x / y) if np.isfinite(x) and y > 0.0 else None
