"""Errors of predicted forces that are to be expected of a fit, by group of rows as in `Metrics`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchid.parameters import Array
from torchid.problem import Samples
from torchid.problem.chunks import spread_by_state
from torchid.problem.plan import State
from torchid.problem.predict import predicted_forces
from torchid.problem.rows import RowBuilder
from torchid.problem.threads import one_thread
from torchid.report.metrics import GROUPS
from torchid.sensing import SensorNoise

_SAMPLES = 400  # a contact state


@dataclass(frozen=True)
class ExpectedErrors:
    """Rms by group of rows: of the model's own error, and of what it is compared with.

    The latter is the noise of torque and contact sensors, and on the base rows that of the differentiated motion, which
    the floors `SensorNoise.base` stand for.
    """

    model: dict[str, float | None]
    sensors: dict[str, float | None]

    @property
    def total(self) -> dict[str, float | None]:
        """What a comparison with measured forces is to show."""
        both = {group: (self.model[group], self.sensors[group]) for group in GROUPS}
        return {group: None if x is None or y is None else float(np.hypot(x, y)) for group, (x, y) in both.items()}


@one_thread()
@torch.no_grad()
def expected_errors(
    builder: RowBuilder, logs: Sequence[Samples], directions: Array, noise: SensorNoise
) -> ExpectedErrors:
    """Errors on some logs.

    Args:
        builder: of an `Evaluation`.
        logs: whose motion the forces are predicted on.
        directions: (M, 12 L), independent errors of the parameters, as `error_directions` gives them.
        noise: of the sensors that recorded these logs, with its floors of the base rows.
    """
    triangle = np.linalg.qr(directions @ builder.columns.from_parameters().T, mode="r")
    columns = torch.from_numpy(triangle).to(builder.device)
    model, sensors = _Squares(builder), _Squares(builder)
    for samples, state, weight in spread_by_state(logs, _SAMPLES):
        samples = samples.to(builder.device)
        terms = builder.terms(samples)
        predicted = torch.stack([predicted_forces(builder, terms, phi).T for phi in columns])
        model.add(samples, state, weight, predicted, predicted)
        rows = _row_noise(builder, samples, noise)
        sensors.add(samples, state, weight, torch.cat([rows, _wrench_noise(builder, samples, state, noise)]), rows)
    return ExpectedErrors(model.rms(), sensors.rms())


def _row_noise(builder: RowBuilder, samples: Samples, noise: SensorNoise) -> Tensor:
    """One standard deviation of each base row's floor and each torque sensor, as generalized forces (nv, B, nv)."""
    n, base = len(builder.columns.joint_rows), builder.tree.base_rows
    std = np.append(noise.base[:base], np.full(n, noise.joint_torque))
    return torch.diag(samples.time.new_tensor(std))[:, None].expand(-1, len(samples), -1)


def _wrench_noise(builder: RowBuilder, samples: Samples, state: State, noise: SensorNoise) -> Tensor:
    """Generalized forces that one standard deviation of each contact sensor makes, (6 C, B, nv)."""
    std = samples.time.new_zeros(len(builder.contacts), 6)
    for contact, active in enumerate(state):
        if active:
            possible = list(builder.contacts[contact].components)
            std[contact, possible] = std.new_tensor(noise.wrench[possible])
    return (builder.contact_jacobian(samples) * std[..., None]).flatten(1, 2).transpose(0, 1)


class _Squares:
    """Weighted sums of squares of independent errors, row by row and inside the contacts' null space."""

    def __init__(self, builder: RowBuilder) -> None:
        self.builder, self.base = builder, builder.tree.base_rows
        self.rows = np.zeros(self.base + len(builder.columns.joint_rows))
        self.inside, self.count, self.inside_count = 0.0, 0.0, 0.0

    def add(self, samples: Samples, state: State, weight: float, errors: Tensor, without_contacts: Tensor) -> None:
        """Add errors (M, B, nv); those that are projected are without the noise of contact sensors."""
        self.rows += weight * errors.square().sum((0, 1)).cpu().numpy()
        self.count += weight * len(samples)
        plan = self.builder.plan(state)
        mixed = [*range(self.base), *(self.base + joint for joint in plan.mixed_joints)]
        lone = [self.base + joint for joint in plan.lone_joints]
        for index, V in self.builder.bases(samples, state):
            inside = V.mT @ without_contacts[:, index][..., mixed, None]
            self.inside += weight * float(inside.square().sum() + without_contacts[:, index][..., lone].square().sum())
            self.inside_count += weight * len(V) * (V.shape[2] + len(lone))

    def rms(self) -> dict[str, float | None]:
        """By group of rows."""
        mean = self.rows / max(self.count, 1.0)
        force, moment = (float(np.sqrt(mean[rows].mean())) for rows in (slice(0, 3), slice(3, 6)))
        return {
            "joint_torque": float(np.sqrt(mean[self.base :]).mean()) if len(mean) > self.base else None,
            "base_force": force if self.base else None,
            "base_moment": moment if self.base else None,
            "nullspace": float(np.sqrt(self.inside / self.inside_count)) if self.inside_count else None,
        }
