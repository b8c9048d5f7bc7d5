"""Errors of predicted forces, gathered over any number of samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchid.parameters import Array
from torchid.problem.chunks import over_chunks
from torchid.problem.plan import State
from torchid.problem.predict import forces
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.sensors import named_sensors

GROUPS = {
    "joint_torque": "joint torque [N m]",
    "base_force": "base force [N]",
    "base_moment": "base moment [N m]",
    "nullspace": "projected [N, N m]",
}
"""Groups of rows that errors are given for, with a name and unit to show."""

SETS = ("train", "test")
"""Sets of logs that errors are given for."""

BASE_ROWS = tuple(f"base {kind} {axis}" for kind in ("force", "moment") for axis in "xyz")
"""Names of the six base rows."""


def group_name(group: str) -> str:
    """Name of a group of rows, without its unit."""
    return GROUPS[group].split(" [")[0]


@dataclass(frozen=True)
class Metrics:
    """Errors of one parameter vector on some logs; None where the logs cannot give a figure.

    `rms` and `relative` by group; `by_joint_rms` and `by_joint_relative` by joint. Relative means rms of the error over
    rms of what was measured. `rms` of "joint_torque" is the mean over joints of their rms, relative to the same mean of
    the measured. `base_force_of_variation` is relative to the rms of the measured base force about its mean, which is
    mostly weight.
    """

    rms: dict[str, float | None]
    relative: dict[str, float | None]
    by_joint_rms: dict[str, float | None]
    by_joint_relative: dict[str, float | None]
    base_force_of_variation: float | None

    def as_dict(self) -> dict[str, object]:
        """As `metrics.json` has it."""
        out: dict[str, object] = {}
        for suffix, groups, joints in (
            ("rms", self.rms, self.by_joint_rms),
            ("rms_relative", self.relative, self.by_joint_relative),
        ):
            for group in GROUPS:
                out[f"{group}_{suffix}"] = groups[group]
                if group == "joint_torque":
                    out[f"joint_torque_{suffix.replace('rms', 'rms_by_joint')}"] = joints
        return out


class _Squares:
    """Sums and sums of squares by row, over the samples where the row is known."""

    def __init__(self, rows: int) -> None:
        self.plain, self.sum, self.count = np.zeros(rows), np.zeros(rows), np.zeros(rows)

    def add(self, x: torch.Tensor) -> None:
        values = x.cpu().numpy()
        known = np.isfinite(values)
        values = np.where(known, values, 0.0)
        self.plain += values.sum(0)
        self.sum += np.square(values).sum(0)
        self.count += known.sum(0)

    def rms(self, rows: slice = slice(None)) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.sum[rows] / self.count[rows])

    def pooled(self, rows: slice) -> float:
        count = self.count[rows].sum()
        return float(np.sqrt(self.sum[rows].sum() / count)) if count else np.nan

    def deviation(self, rows: slice) -> float:
        """Rms about the mean of each row, over all of them."""
        known = self.count[rows] > 0
        count, plain = self.count[rows][known], self.plain[rows][known]
        if not len(count):
            return np.nan
        return float(np.sqrt(max((self.sum[rows][known] - plain**2 / count).sum(), 0.0) / count.sum()))

    def merge(self, other: _Squares) -> None:
        self.plain += other.plain
        self.sum += other.sum
        self.count += other.count


class _Sums:
    """Of generalized forces (or their errors): rows as they are, and inside the contacts' null space."""

    def __init__(self, nv: int) -> None:
        self.rows, self.projected = _Squares(nv), _Squares(1)

    @classmethod
    def total(cls, parts: Sequence[_Sums]) -> _Sums:
        out = cls(len(parts[0].rows.sum))
        for part in parts:
            out.rows.merge(part.rows)
            out.projected.merge(part.projected)
        return out


class Evaluation:
    """Evaluates several parameter vectors at once, in one pass over the logs."""

    def __init__(self, robot: Robot, contacts: Sequence[Contact], device: str = "cpu") -> None:
        """Fix robot and contacts; sensors do not matter, whatever a log has is used."""
        self.robot = robot
        self.builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, len(contacts))).to(device)

    def metrics(
        self, logs: Sequence[Samples], phi: Array, progress: Callable[[int], None] | None = None
    ) -> list[Metrics]:
        """One `Metrics` per row of `phi`, (M, 12 L), over all samples of the logs together."""
        builder = self.builder
        columns = torch.from_numpy(phi @ builder.columns.from_parameters().T).to(builder.device)

        def fold(chunks: Iterator[tuple[Samples, State]]) -> list[_Sums]:
            sums = [_Sums(self.robot.nv) for _ in range(len(phi) + 1)]
            for samples, state in chunks:
                found = forces(builder, samples, state, columns)
                for total, predicted in zip(sums, (torch.zeros_like(found.torque), *found.predicted), strict=True):
                    total.rows.add(predicted - found.measured)
                projected = [total.projected for total in sums]
                self._project(samples, state, [found.torque, *(found.predicted - found.torque)], projected)
            return sums

        parts = over_chunks(logs, builder, fold, progress=progress)
        measured, *errors = [_Sums.total(same) for same in zip(*parts, strict=True)]
        return [self._summary(error, measured) for error in errors]

    def _project(
        self, samples: Samples, state: State, vectors: Sequence[torch.Tensor], sums: Sequence[_Squares]
    ) -> None:
        """Add V_x^T of each (B, nv), V_x the contacts' null space; joints away from contacts pass unchanged."""
        plan, base = self.builder.plan(state), self.robot.base_rows
        mixed = [*range(base), *(base + joint for joint in plan.mixed_joints)]
        lone = [base + joint for joint in plan.lone_joints]
        for index, V in self.builder.bases(samples, state):
            for vector, squares in zip(vectors, sums, strict=True):
                inside = (V.mT @ vector[index][:, mixed, None])[..., 0]
                squares.add(torch.cat([inside, vector[index][:, lone]], dim=1).flatten()[:, None])

    def _summary(self, errors: _Sums, measured: _Sums) -> Metrics:
        base = self.robot.base_rows
        rms: dict[str, float] = {}
        size: dict[str, float] = {}
        for sums, out in ((errors, rms), (measured, size)):
            squares, inside = sums.rows, sums.projected
            joints = squares.rms(slice(base, None))
            out["joint_torque"] = float(np.nanmean(joints)) if np.isfinite(joints).any() else np.nan
            out["base_force"] = squares.pooled(slice(0, 3)) if base else np.nan
            out["base_moment"] = squares.pooled(slice(3, 6)) if base else np.nan
            out["nullspace"] = inside.pooled(slice(None))
        by_joint, joint_size = errors.rows.rms(slice(base, None)), measured.rows.rms(slice(base, None))
        names = self.robot.joint_names
        return Metrics(
            {group: _figure(rms[group]) for group in GROUPS},
            {group: _ratio(rms[group], size[group]) for group in GROUPS},
            {name: _figure(x) for name, x in zip(names, by_joint, strict=True)},
            {name: _ratio(x, y) for name, x, y in zip(names, by_joint, joint_size, strict=True)},
            _ratio(rms["base_force"], measured.rows.deviation(slice(0, 3)) if base else np.nan),
        )


def _figure(x: float) -> float | None:
    return float(x) if np.isfinite(x) else None


def _ratio(x: float, y: float) -> float | None:
    return float(x / y) if np.isfinite(x) and y > 0.0 else None
