"""Expected errors of a fit: of its parameters, and of the forces that it predicts on any motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.identifiability.information import triangular_factor
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import one_thread, subsample_states
from torchid.problem.contact_state import ContactState
from torchid.problem.metrics import ROW_GROUPS, ForceSums, finite_or_none, null_space_components
from torchid.problem.predict import predict_forces
from torchid.rounding import RANK_TOLERANCE
from torchid.sensing import SensorNoise

_SAMPLES = 400  # a contact state


@dataclass(frozen=True)
class ExpectedErrors:
    """Rms by group of rows: of the model's own error, and of what it is compared with.

    The latter is the noise of torque and contact sensors, and on the base rows that of the differentiated motion,
    `SensorNoise.base`.
    """

    model: dict[str, float | None]
    sensors: dict[str, float | None]

    @property
    def total(self) -> dict[str, float | None]:
        """Expected difference between predicted and measured forces."""
        pairs = {group: (self.model[group], self.sensors[group]) for group in ROW_GROUPS}
        return {group: None if x is None or y is None else float(np.hypot(x, y)) for group, (x, y) in pairs.items()}


@one_thread()
@torch.no_grad()
def expected_errors(
    builder: RowBuilder, logs: Sequence[Samples], directions: Array, noise: SensorNoise
) -> ExpectedErrors:
    """Expected errors of predicted forces on some logs.

    Args:
        builder: of an `Evaluation`.
        logs: whose motion the forces are predicted on.
        directions: (M, 12 L), independent errors of the parameters, as `error_directions` gives them.
        noise: of the sensors that recorded these logs, with its floors of the base rows.
    """
    columns = torch.from_numpy(triangular_factor(directions @ builder.columns.parameter_map().T)).to(builder.device)
    base, nv = builder.tree.base_rows, builder.tree.base_rows + len(builder.columns.joint_rows)
    model, sensors = ForceSums(nv), ForceSums(nv)
    for samples, state, weight in subsample_states(logs, _SAMPLES):
        samples = samples.to(builder.device)
        terms = builder.dynamics(samples)
        predicted = torch.stack([predict_forces(builder, terms, phi).T for phi in columns])
        rows = _row_noise(builder, samples, noise)
        through_contacts = _wrench_noise(builder, samples, state, noise)
        for sums, errors, without_contacts in (
            (model, predicted, predicted),
            (sensors, torch.cat([rows, through_contacts]), rows),
        ):
            sums.rows.add(_together(errors), weight)
            for inside in null_space_components(builder, samples, state, without_contacts):
                sums.projected.add(_together(inside).flatten()[:, None], weight)
    errors_rms = (sums.rms(base, builder.tree.n) for sums in (model, sensors))
    return ExpectedErrors(*({group: finite_or_none(rms[group]) for group in ROW_GROUPS} for rms in errors_rms))


@one_thread()
def error_directions(
    problem: LinearProblem,
    ridge: float,
    noise_variance: float,
    prior_error: float,
    rank_tolerance: float = RANK_TOLERANCE,
) -> Array:
    """Independent errors of least squares with a ridge, (M, P): their outer products sum up to the error's covariance.

    Along each right singular vector of the scaled problem, with singular value s and r = ridge * rows, the noise of the
    rows enters by s / (s^2 + r) and the error of the nominal parameters stays by r / (s^2 + r); along directions that
    no row depends on it stays in full. This is exact for white noise and independent nominal errors of one size.

    Args:
        problem: of the training logs.
        ridge: of the fit.
        noise_variance: of the whitened rows, as if they were independent.
        prior_error: standard deviation of the nominal parameters, as a share of `problem.scale`.
        rank_tolerance: of the fit.
    """
    scale = problem.scale[problem.free]
    _, values, Vh = scipy.linalg.svd(problem.A[:, problem.free] * scale, lapack_driver="gesvd")  # see `base_parameters`
    values = np.pad(values, (0, len(scale) - len(values)))
    values[values <= rank_tolerance * values.max(initial=0.0)] = 0.0
    prior = ridge * problem.rows
    with np.errstate(invalid="ignore", divide="ignore"):
        through = np.where(values > 0.0, values / (values**2 + prior), 0.0)
        kept = np.where(values > 0.0, prior / (values**2 + prior), 1.0)
    length = np.hypot(np.sqrt(noise_variance) * through, prior_error * kept)
    directions = np.zeros((len(scale), len(problem.free)))
    directions[:, problem.free] = length[:, None] * Vh * scale
    return directions


def _together(errors: Tensor) -> Tensor:
    """Standard deviation of the sum of independent errors, (M, B, r) to (B, r)."""
    return errors.square().sum(0).sqrt()


def _row_noise(builder: RowBuilder, samples: Samples, noise: SensorNoise) -> Tensor:
    """Forces (n_rows, B, n_rows) of one standard deviation of each base row's floor and each torque sensor."""
    n, base = builder.tree.n_dofs, builder.tree.base_rows
    std = np.append(noise.base_std[:base], noise.dof_std(builder.tree.n, n))
    rows = torch.diag(samples.time.new_tensor(std))[:, None].expand(-1, len(samples), -1)
    axes = builder.noise_axes(samples.rotation_world_base) if noise.base_axes_differ else None
    if axes is None:
        return rows
    force, moment, rest = rows.split([3, 3, len(std) - 6], dim=2)
    turned = [(axes @ part.permute(1, 2, 0)).permute(2, 0, 1) for part in (force, moment)]
    return torch.cat([*turned, rest], dim=2)


def _wrench_noise(builder: RowBuilder, samples: Samples, state: ContactState, noise: SensorNoise) -> Tensor:
    """Generalized forces that one standard deviation of each contact sensor makes, (6 C, B, n_rows)."""
    std = samples.time.new_zeros(len(builder.contacts), 6)
    for contact, active in enumerate(state):
        if active:
            possible = list(builder.contacts[contact].components)
            std[contact, possible] = std.new_tensor(noise.wrench_std[possible])
    return (builder.contact_jacobian(samples) * std[..., None]).flatten(1, 2).transpose(0, 1)
