"""Information about the parameters, by log, contact state and sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import ProgressCallback, chunks_by_state, subsample_states
from torchid.problem.compression import Part
from torchid.problem.contact_state import ContactState, state_name
from torchid.problem.elimination import eliminate_columns
from torchid.problem.unloaded_sensors import unloaded_offset_equations
from torchid.rounding import KINEMATIC_TOLERANCE, RANK_TOLERANCE, numerical_rank
from torchid.sensing.sensors import measured_components

INFORMATION_SAMPLES = 2000
"""Approximate number of samples whose rows represent those of all."""

_CHUNK = 256  # samples whose rows are computed together


@dataclass(frozen=True)
class InformationGain:
    """Information gained over the prior that each free parameter is within one scale of its nominal value.

    With H the information of the whitened rows in units of the scales: `bits` = log2 det(I + H) / 2, the total number
    of halvings of the standard deviations; `determined` = tr((I + H)^-1 H), the number of combinations that the data
    determine better than the prior. Source: Bayesian linear regression; MacKay, "Bayesian interpolation", 1992.
    """

    bits: float
    determined: float

    @classmethod
    def of(cls, information: Array) -> InformationGain:
        """From the eigenvalues of H, (M,), at least 0 except for rounding."""
        values = np.maximum(information, 0.0)
        return cls(float(np.log1p(values).sum() / np.log(4.0)), float((values / (1.0 + values)).sum()))

    def __sub__(self, other: InformationGain) -> InformationGain:
        return InformationGain(self.bits - other.bits, self.determined - other.determined)


@dataclass(frozen=True)
class SensorInformation:
    """Information (columns, columns) of all sensors together, and the part of it that is lost without each.

    `torques`: by index of the joint; `limbs`: by index of the force/torque sensor in a limb; `wrenches`: by index of
    the contact. Each sensor counts with all its measured components.
    """

    total: Array
    torques: Mapping[int, Array]
    limbs: Mapping[int, Array]
    wrenches: Mapping[int, Array]

    def map(self, change: Callable[[Array], Array]) -> SensorInformation:
        """The same with every matrix changed by a linear map."""
        return SensorInformation(
            change(self.total),
            *(
                {index: change(H) for index, H in matrices.items()}
                for matrices in (self.torques, self.limbs, self.wrenches)
            ),
        )

    def marginal(self, unknown: Sequence[int]) -> SensorInformation:
        """Information about the other columns, where some are unknown."""
        size = np.diag(self.total)[list(unknown)]
        total = _marginal_information(self.total, unknown, size)
        lost = self.map(lambda H: total - _marginal_information(self.total - H, unknown, size))
        return replace(lost, total=total)


@one_thread()
@torch.no_grad()
def sensor_information(
    logs: Sequence[Samples], builder: RowBuilder, most: int = INFORMATION_SAMPLES, done: ProgressCallback | None = None
) -> SensorInformation:
    """Information of some logs in the builder's columns, and the part of it due to each sensor.

    That part is, in each sample, what the sensor's `reading_directions` take from the whitened rows.

    Args:
        logs: bound logs.
        builder: of their rows.
        most: approximate number of samples that represent all.
        done: called with the number of samples worked through.
    """
    n = builder.tree.n
    base = builder.tree.base_rows
    joints = [x for x in np.flatnonzero(builder.sensors.torque[:n]).tolist() if x not in builder.motors.passive]
    in_limbs = builder.sensors.torque[n:].reshape(-1, 6)
    limbs = np.flatnonzero(in_limbs.any(axis=1)).tolist()
    components = measured_components(builder.contacts, builder.sensors)
    contacts = np.flatnonzero(components.any(axis=1)).tolist()
    count = builder.width
    first = 1 + len(joints) + len(limbs)
    units = torch.eye(builder.tree.n_rows, dtype=torch.float64, device=builder.device)
    torques = units[[base + joint for joint in joints]]
    total = torch.zeros(first + len(contacts), count, count, dtype=torch.float64, device=builder.device)
    for samples, state, represented in _spread(logs, most):
        weight = represented / samples.oversampling
        rows, W = builder.rows_by_sample(samples.to(builder.device), state)
        K = rows[..., :-1]
        total[0] += rows_information(K, weight)
        lost = (reading_directions(torques, W) @ K).transpose(0, 1)  # (joints, B, columns)
        total[1 : 1 + len(joints)].baddbmm_(lost.mT, lost, alpha=weight)
        for index, limb in enumerate(limbs, start=1 + len(joints)):
            C = units[(base + n + 6 * limb + np.flatnonzero(in_limbs[limb])).tolist()]
            total[index] += rows_information(_span(C.expand(len(samples), *C.shape), W) @ K, weight)
        for contact, H in _unloaded_information(builder, samples, count):
            total[0] += weight * H
            total[first + contacts.index(contact)] += weight * H
        if any(state[contact] for contact in contacts):
            J = builder.contact_jacobian(samples.to(builder.device))
            for index, contact in enumerate(contacts, start=first):
                if state[contact]:
                    C = J[:, contact, np.flatnonzero(components[contact]).tolist()]
                    total[index] += rows_information(_span(C, W) @ K, weight)
        if done is not None:
            done(len(samples))
    information = total.cpu().numpy()
    return SensorInformation(
        information[0],
        dict(zip(joints, information[1:], strict=False)),
        dict(zip(limbs, information[1 + len(joints) :], strict=False)),
        dict(zip(contacts, information[first:], strict=True)),
    )


def add_information(parts: Sequence[SensorInformation]) -> SensorInformation:
    """Sum over logs whose only common unknowns are the columns."""

    def added(matrices: Sequence[Mapping[int, Array]]) -> dict[int, Array]:
        return {index: np.asarray(sum(part[index] for part in matrices)) for index in matrices[0]}

    return SensorInformation(
        np.asarray(sum(part.total for part in parts)),
        added([part.torques for part in parts]),
        added([part.limbs for part in parts]),
        added([part.wrenches for part in parts]),
    )


def prior_directions(builder: RowBuilder, prior: Array) -> Array:
    """N, (columns, M): rows X in the builder's columns have the information `N^T X^T X N`.

    `N N^T` is the prior covariance of the columns' parameters, for independent parameters with standard deviations
    `prior`, (12 L,), 0 where known, and extras with their size.
    """
    rigid = triangular_factor((builder.columns.parameter_map * prior).T).T
    return np.asarray(scipy.linalg.block_diag(rigid, np.diag([extra.size for extra in builder.extras])))


def _marginal_information(H: Array, unknown: Sequence[int], size: Array) -> Array:
    """Information about some columns with others unknown: the Schur complement, as `eliminate_columns` on rows.

    Args:
        H: (N, N), X^T X.
        unknown: indices of M columns.
        size: (M,), squared norms of these; values below the fraction `KINEMATIC_TOLERANCE` are rounding.
    """
    if not unknown:
        return H
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    crossed = np.delete(H[list(unknown)], unknown, axis=1) * scale[:, None]
    values, V = np.linalg.eigh(H[np.ix_(unknown, unknown)] * scale * scale[:, None])
    along = V[:, values > KINEMATIC_TOLERANCE].T @ crossed
    kept = np.delete(np.delete(H, unknown, axis=0), unknown, axis=1)
    return np.asarray(kept - along.T @ (along / values[values > KINEMATIC_TOLERANCE, None]))


def rows_information(rows: Tensor, weight: float) -> Tensor:
    """`weight X^T X`, (c, c), of the rows X of all samples together, (B, r, c)."""
    X = rows.flatten(0, 1)
    return weight * (X.T @ X)


def reading_directions(ways: Tensor, W: Tensor) -> Tensor:
    """Rows `ways W`, (B, c, nv), of norm 1, or zero where they are rounding.

    A sensor that enters the generalized force of a sample by `way^T` times its reading contributes the part of the
    whitened rows `W^T K` along `W^T way^T`: without it `W W^T` loses just that part.

    Args:
        ways: (B, c, n_rows) or (c, n_rows).
        W: (B, n_rows, n_rows), from `RowBuilder.rows_by_sample`.
    """
    readings = ways @ W
    size = torch.linalg.vector_norm(readings, dim=-1, keepdim=True)
    least = KINEMATIC_TOLERANCE * torch.linalg.matrix_norm(W)[:, None, None] * ways.norm(dim=-1, keepdim=True)
    return torch.where(size > least, readings / size, 0.0)


def triangular_factor(X: Array) -> Array:
    """Triangular R, (min(M, N), N), with `R^T R = X^T X`."""
    return np.asarray(np.linalg.qr(X, mode="r"))


def _unloaded_information(builder: RowBuilder, samples: Samples, count: int) -> Iterator[tuple[int, Tensor]]:
    """Contacts, and the information (count, count) of their readings in the air about offsets."""
    for channel in unloaded_offset_equations(builder, samples):
        if not channel.masked and (index := builder.extras[channel.offset].contact):
            columns, row = channel.row(builder)
            wide = row.new_zeros(count)
            wide[list(columns)] = row[0, :-1]
            yield index[0], torch.outer(wide, wide).to(builder.device)


def _spread(logs: Sequence[Samples], most: int) -> Iterator[tuple[Samples, ContactState, float]]:
    """Chunks of about `most` samples, evenly spread over contact states and logs, and how many each represents."""
    states = {state for samples in logs for state, _ in chunks_by_state(samples)}
    for samples, state, represented in subsample_states(logs, max(most // max(len(states), 1), 1)):
        for start in range(0, len(samples), _CHUNK):
            yield samples[start : start + _CHUNK], state, represented


def _span(C: Tensor, W: Tensor) -> Tensor:
    """Orthonormal rows, (B, c, n_rows), that span those of `C W`, zeros for dependent ones."""
    _, values, Vh = torch.linalg.svd(C @ W, full_matrices=False)
    least = KINEMATIC_TOLERANCE * torch.linalg.matrix_norm(C) * torch.linalg.matrix_norm(W)
    return Vh * (values > least[:, None])[..., None]


@dataclass(frozen=True)
class Contribution:
    """Bits and determined combinations, as in `InformationGain`, that are lost without a part of the data."""

    name: str
    bits: float
    determined: float


@dataclass(frozen=True)
class PartContribution(Contribution):
    """Of a log or a contact state: its samples, the rank of its rows, and the rank that all lose without it."""

    samples: int
    rank: int
    rank_lost: int


@dataclass(frozen=True)
class SensorContribution(Contribution):
    """Of a sensor: `kind` is "joint torque", "wrench in a limb" or "contact wrench", with all measured components."""

    kind: str


@dataclass(frozen=True)
class Contributions:
    """Of all data together, and of each log, contact state (most frequent first) and sensor (largest first)."""

    total: InformationGain
    logs: list[PartContribution]
    states: list[PartContribution]
    sensors: list[SensorContribution]


@one_thread()
def contributions(
    parts: Sequence[Part],
    logs: Sequence[Samples],
    builder: RowBuilder,
    problem: LinearProblem,
    dof_names: Sequence[str],
    rank_tolerance: float = RANK_TOLERANCE,
    done: ProgressCallback | None = None,
) -> Contributions:
    """Information that each log, contact state and sensor contributes, by leaving it out.

    Contributions are to the bodies' parameters; offsets, scales and actuator terms are nuisance parameters. They are
    exact for logs and contact states, and approximate for sensors (see `sensor_information`).

    Args:
        parts: of the logs.
        logs: bound logs; empty to skip sensors, which need samples.
        builder: of the rows.
        problem: of all parts, for its scales and free parameters.
        dof_names: of the robot.
        rank_tolerance: as in `LeastSquares`.
        done: called with the number of samples processed.
    """
    directions = prior_directions(builder, problem.scale * problem.free)
    first = directions.shape[1] - len(builder.extras)  # nuisance parameters are last
    of_log = [first + number for number, extra in enumerate(builder.extras) if extra.per_log]
    nuisance = NuisanceColumns(of_log, list(range(first, directions.shape[1] - len(of_log))))
    data = ScaledParts(parts, directions, nuisance)
    by_log = leave_one_out(data, [part.source for part in parts], rank_tolerance)
    by_state = leave_one_out(data, [state_name(builder.contacts, part.state) for part in parts], rank_tolerance)
    by_state.sort(key=lambda state: -state.samples)
    sensors: list[SensorContribution] = []
    if logs:
        information = _sensor_information(logs, builder, directions, nuisance, done)
        sensors = _sensors(information.marginal(nuisance.of_all), builder, dof_names)
    return Contributions(InformationGain.of(data.everything**2), by_log, by_state, sensors)


@dataclass(frozen=True)
class NuisanceColumns:
    """Columns of nuisance parameters: offsets, scales and actuator terms.

    `of_log`: indices of those that differ between logs; `of_all`: of the common ones, after `of_log` are removed.
    """

    of_log: list[int]
    of_all: list[int]


class ScaledParts:
    """Parts of logs with factors X: `X^T X` is a part's information in scaled columns, for correlated noise."""

    def __init__(self, parts: Sequence[Part], directions: Array, nuisance: NuisanceColumns) -> None:
        self.parts = parts
        self.nuisance = nuisance
        self._factors = [
            part.factor.triangle().numpy()[:-1, :-1] @ directions / np.sqrt(part.factor.oversampling) for part in parts
        ]

    def together(self, chosen: Sequence[int]) -> Array:
        """X of some parts, with the nuisance parameters of each log eliminated."""
        by_source: dict[str, list[Array]] = {}
        for i in chosen:
            by_source.setdefault(self.parts[i].source if self.nuisance.of_log else "", []).append(self._factors[i])
        empty = np.empty((0, self._factors[0].shape[1] - len(self.nuisance.of_log)))
        logs = (triangular_factor(np.concatenate(same)) for same in by_source.values())
        of_sources = (eliminate_columns(X, self.nuisance.of_log) for X in logs)
        return triangular_factor(np.concatenate([empty, *of_sources]))

    @cached_property
    def everything(self) -> Array:
        """Singular values of all parts together."""
        return self.singular_values(self.together(range(len(self.parts))))

    def singular_values(self, X: Array) -> Array:
        """Of X of several logs with nuisance parameters eliminated, descending."""
        reduced = eliminate_columns(triangular_factor(X), self.nuisance.of_all)
        return np.asarray(np.linalg.svd(reduced, compute_uv=False))


def leave_one_out(data: ScaledParts, names: Sequence[str], rank_tolerance: float) -> list[PartContribution]:
    """Contribution of the parts of each name, by the `names` of all parts; `rank_tolerance` as in `LeastSquares`."""

    def rank(values: Array) -> int:
        return numerical_rank(values, rank_tolerance, values.shape)

    groups = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    factors = [data.together(chosen) for chosen in groups.values()]
    everything = data.everything
    out = []
    for name, factor, others in zip(groups, factors, _factors_of_others(data, groups, factors), strict=True):
        without = data.singular_values(others)
        lost = InformationGain.of(everything**2) - InformationGain.of(without**2)
        samples = sum(data.parts[i].samples for i in groups[name])
        own_rank = rank(data.singular_values(factor))
        rank_lost = rank(everything) - rank(without)
        out.append(PartContribution(name, lost.bits, lost.determined, samples, own_rank, rank_lost))
    return out


def _factors_of_others(data: ScaledParts, groups: dict[str, list[int]], factors: Sequence[Array]) -> Iterator[Array]:
    """X of all parts except those of each group."""
    logs = [{data.parts[i].source for i in chosen} for chosen in groups.values()]
    if not data.nuisance.of_log or sum(map(len, logs)) == len(set().union(*logs)):
        yield from _without_each(factors)
        return
    for chosen in groups.values():  # groups share logs and their nuisance parameters
        yield data.together([i for i in range(len(data.parts)) if i not in set(chosen)])


def _without_each(factors: Sequence[Array]) -> Iterator[Array]:
    """For each factor, the merged factor of all others."""
    empty = factors[0][:0]
    after = [empty]
    for factor in reversed(factors[1:]):
        after.append(triangular_factor(np.concatenate([factor, after[-1]])))
    before = empty
    for factor in factors:
        yield np.concatenate([before, after.pop()])
        before = triangular_factor(np.concatenate([before, factor]))


def _sensor_information(
    logs: Sequence[Samples],
    builder: RowBuilder,
    directions: Array,
    nuisance: NuisanceColumns,
    done: ProgressCallback | None,
) -> SensorInformation:
    """`sensor_information` in scaled columns, without the nuisance parameters of each log."""

    def scaled(H: Array) -> Array:
        return np.asarray(directions.T @ H @ directions)

    if not nuisance.of_log:
        return sensor_information(logs, builder, done=done).map(scaled)
    sources = {samples.source: [other for other in logs if other.source == samples.source] for samples in logs}
    most = max(INFORMATION_SAMPLES // len(sources), 1)
    of_logs = (sensor_information(same, builder, most, done).map(scaled) for same in sources.values())
    return add_information([information.marginal(nuisance.of_log) for information in of_logs])


def _sensors(information: SensorInformation, builder: RowBuilder, dof_names: Sequence[str]) -> list[SensorContribution]:
    """Contributions of all sensors, largest first."""

    def gain(H: Array) -> InformationGain:
        return InformationGain.of(np.asarray(np.linalg.eigvalsh(H)))

    everything = gain(information.total)
    out = []
    limbs = [name.rpartition(".")[0] for name in dof_names[builder.tree.n :: 6]]
    for kind, names, lost in (
        ("joint torque", dof_names, information.torques),
        ("wrench in a limb", limbs, information.limbs),
        ("contact wrench", [contact.frame for contact in builder.contacts], information.wrenches),
    ):
        for index, H in lost.items():
            difference = everything - gain(information.total - H)
            out.append(SensorContribution(names[index], difference.bits, difference.determined, kind))
    return sorted(out, key=lambda sensor: -sensor.bits)
