"""Errors of predicted forces, gathered over any number of samples."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from torchid.parameters import Array
from torchid.problem.chunks import over_chunks
from torchid.problem.extras import ExtraTerms
from torchid.problem.plan import State
from torchid.problem.predict import forces
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.report.sums import WHITENED, ForceSums, figure, projected
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

SHOWN = GROUPS | {WHITENED: "whitened [x noise]"}
"""Those, and the whitened projected residual of a fit's own rows, which there is with any sensors."""

LIMB_GROUPS = {"ft_force": "force in limbs [N]", "ft_moment": "moment in limbs [N m]"}
"""Readings of force/torque sensors in limbs, of robots that have some."""

SETS = ("train", "test")
"""Sets of logs that errors are given for."""

BASE_ROWS = tuple(f"base {kind} {axis}" for kind in ("force", "moment") for axis in "xyz")
"""Names of the six base rows."""


def group_name(group: str) -> str:
    """Name of a group of rows, without its unit."""
    return SHOWN[group].split(" [")[0]


@dataclass(frozen=True)
class Metrics:
    """Errors of one parameter vector on some logs; None where the logs cannot give a figure.

    `rms` and `relative` by group of `SHOWN`, the last in units of the stated noise; `by_joint_rms` and
    `by_joint_relative` by joint. Relative means rms of the error over
    rms of what was measured. `rms` of "joint_torque" is the mean over joints of their rms, relative to the same mean of
    the measured. `base_force_of_variation` is relative to the rms of the measured base force about its mean, which is
    mostly weight. `limb_rms` and `limb_relative` by `LIMB_GROUPS`, empty for a robot without sensors in limbs.
    """

    rms: dict[str, float | None]
    relative: dict[str, float | None]
    by_joint_rms: dict[str, float | None]
    by_joint_relative: dict[str, float | None]
    base_force_of_variation: float | None
    limb_rms: dict[str, float | None] = field(default_factory=dict)
    limb_relative: dict[str, float | None] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """As `metrics.json` has it."""
        out: dict[str, object] = {}
        for suffix, groups, joints, limbs in (
            ("rms", self.rms, self.by_joint_rms, self.limb_rms),
            ("rms_relative", self.relative, self.by_joint_relative, self.limb_relative),
        ):
            out |= {f"{group}_{suffix}": x for group, x in limbs.items()}
            for group in GROUPS:
                out[f"{group}_{suffix}"] = groups[group]
                if group == "joint_torque":
                    out[f"joint_torque_{suffix.replace('rms', 'rms_by_joint')}"] = joints
        return out | {WHITENED: self.rms.get(WHITENED), f"{WHITENED}_relative": self.relative.get(WHITENED)}


class Evaluation:
    """Evaluates several parameter vectors at once, in one pass over the logs."""

    def __init__(
        self, robot: Robot, contacts: Sequence[Contact], device: str = "cpu", terms: ExtraTerms | None = None
    ) -> None:
        """Fix robot, contacts and what actuators add; sensors do not matter, whatever a log has is used."""
        actuators = replace(terms or ExtraTerms(), offsets={}, scales={})
        self.robot = robot
        sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
        self.builder = RowBuilder(robot, contacts, sensors, actuators).to(device)

    def metrics(
        self, logs: Sequence[Samples], phi: Array, progress: Callable[[int], None] | None = None
    ) -> list[Metrics]:
        """One `Metrics` per row of `phi`, as `RowBuilder.columns_of`, over all samples of the logs together.

        Without the whitened projected residual, which depends on sensors.
        """
        measured, *errors = self.sums(logs, phi, progress)
        return [self.summary(measured, error) for error in errors]

    def sums(
        self, logs: Sequence[Samples], phi: Array, progress: Callable[[int], None] | None = None
    ) -> list[ForceSums]:
        """Of the measured forces, then of the errors of each row of `phi`."""
        builder = self.builder
        columns = builder.columns_of(phi)

        def fold(chunks: Iterator[tuple[Samples, State]]) -> list[ForceSums]:
            sums = [ForceSums(self.robot.base_rows + self.robot.dofs) for _ in range(len(phi) + 1)]
            for samples, state in chunks:
                found = forces(builder, samples, state, columns)
                for total, predicted in zip(sums, (torch.zeros_like(found.torque), *found.predicted), strict=True):
                    total.rows.add(predicted - found.measured)
                vectors = torch.cat([found.torque[None], found.predicted - found.torque])
                for group in projected(builder, samples, state, vectors):
                    for total, inside in zip(sums, group, strict=True):
                        total.projected.add(inside.flatten()[:, None])
            return sums

        parts = over_chunks(logs, builder, fold, progress=progress)
        return [ForceSums.total(same) for same in zip(*parts, strict=True)]

    def summary(self, measured: ForceSums, errors: ForceSums) -> Metrics:
        """What sums say."""
        base = self.robot.base_rows
        rms, size = errors.rms(base, self.robot.n), measured.rms(base, self.robot.n)
        joints = slice(base, base + self.robot.n)
        by_joint, joint_size = errors.rows.rms(joints), measured.rows.rms(joints)
        groups = SHOWN if errors.whitened.count.any() else GROUPS
        names, limbs = self.robot.joint_names, LIMB_GROUPS if self.robot.ft_names else {}
        return Metrics(
            {group: figure(rms[group]) for group in groups},
            {group: _ratio(rms[group], size[group]) for group in groups},
            {name: figure(x) for name, x in zip(names, by_joint, strict=True)},
            {name: _ratio(x, y) for name, x, y in zip(names, by_joint, joint_size, strict=True)},
            _ratio(rms["base_force"], measured.rows.deviation(slice(0, 3)) if base else np.nan),
            {group: figure(rms[group]) for group in limbs},
            {group: _ratio(rms[group], size[group]) for group in limbs},
        )


def _ratio(x: float, y: float) -> float | None:
    return float(x / y) if np.isfinite(x) and y > 0.0 else None
