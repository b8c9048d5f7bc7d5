"""What each log, contact state and sensor adds: what would be lost without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchid.analysis.information import DEPENDENT, Knowledge, prior_directions, singular_values, triangle
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import by_state, spread_by_state
from torchid.problem.plan import State, state_name
from torchid.problem.samples import measured_components
from torchid.problem.streaming import Part
from torchid.problem.threads import one_thread

SAMPLES = 2000  # whose rows stand for those of all, where every sensor is left out in turn
_CHUNK = 256  # samples whose rows are computed together


@dataclass(frozen=True)
class Contribution:
    """Bits and combinations, as in `Knowledge`, that are lost without a part of the data."""

    name: str
    bits: float
    determined: float


@dataclass(frozen=True)
class PartContribution(Contribution):
    """Of a log or a contact state: its samples, the rank of its rows alone, and how far that of all falls without."""

    samples: int
    rank: int
    rank_lost: int


@dataclass(frozen=True)
class SensorContribution(Contribution):
    """Of a sensor: `kind` is "joint torque" or "contact wrench", the latter with all its measured components."""

    kind: str


@dataclass(frozen=True)
class Contributions:
    """What all data tell, and what each log, contact state (most frequent first) and sensor adds (most first)."""

    known: Knowledge
    logs: list[PartContribution]
    states: list[PartContribution]
    sensors: list[SensorContribution]


@one_thread()
def contributions(
    parts: Sequence[Part],
    logs: Sequence[Samples],
    builder: RowBuilder,
    problem: LinearProblem,
    joint_names: Sequence[str],
    rank_tolerance: float = 1e-10,
    done: Callable[[int], None] | None = None,
) -> Contributions:
    """Leave every log, contact state and sensor out in turn.

    Logs and contact states are exact. Sensors are judged by about `SAMPLES` samples that stand for all.

    Args:
        parts: of the logs.
        logs: bound logs.
        builder: of their rows.
        problem: of all parts; only its scales and what is free matter.
        joint_names: of the robot.
        rank_tolerance: as in `LeastSquares`.
        done: called with the number of samples worked through.
    """
    directions = prior_directions(builder, problem.scale * problem.free)
    factors = [_information_factor(part, directions) for part in parts]
    states = _groups(parts, factors, [state_name(builder.contacts, part.state) for part in parts])
    states.sort(key=lambda group: -group.samples)
    everything = singular_values(np.concatenate([group.factor for group in states]))
    by_log, by_contact_state = (
        _left_out(groups, everything, rank_tolerance)
        for groups in (_groups(parts, factors, [part.source for part in parts]), states)
    )
    information = sensor_information(logs, builder, done=done)
    sensors = _sensors(information, directions, builder, joint_names)
    return Contributions(Knowledge.of(everything**2), by_log, by_contact_state, sensors)


def _information_factor(part: Part, directions: Array) -> Array:
    """X with `X^T X` the information of a part, correlated noise taken into account."""
    R = part.factor.triangle().numpy()[:-1, :-1]
    return np.asarray(R @ directions / np.sqrt(part.factor.oversampling))


@dataclass(frozen=True)
class _Group:
    """Parts that are left out together, and X with `X^T X` their information."""

    name: str
    samples: int
    factor: Array


def _groups(parts: Sequence[Part], factors: Sequence[Array], names: Sequence[str]) -> list[_Group]:
    """Parts of one name together."""
    members = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    return [
        _Group(name, sum(parts[i].samples for i in chosen), triangle(np.concatenate([factors[i] for i in chosen])))
        for name, chosen in members.items()
    ]


def _left_out(groups: Sequence[_Group], everything: Array, rank_tolerance: float) -> list[PartContribution]:
    """What is lost without each group, with the singular values of all together."""
    out = []
    for group, others in zip(groups, _without_each([group.factor for group in groups]), strict=True):
        rest = singular_values(others)
        lost = Knowledge.of(everything**2) - Knowledge.of(rest**2)
        rank = _rank(singular_values(group.factor), rank_tolerance)
        rank_lost = _rank(everything, rank_tolerance) - _rank(rest, rank_tolerance)
        out.append(PartContribution(group.name, lost.bits, lost.determined, group.samples, rank, rank_lost))
    return out


def _without_each(factors: Sequence[Array]) -> Iterator[Array]:
    """For every factor, one of all others, from those of the ones before and after it: no pair is merged twice."""
    nothing = factors[0][:0]
    after = [nothing]
    for factor in reversed(factors[1:]):
        after.append(triangle(np.concatenate([factor, after[-1]])))
    before = nothing
    for factor in factors:
        yield np.concatenate([before, after.pop()])
        before = triangle(np.concatenate([before, factor]))


def _rank(values: Array, tolerance: float) -> int:
    least = max(tolerance, np.finfo(float).eps * len(values)) * values.max(initial=0.0)
    return int((values > least).sum())


@dataclass(frozen=True)
class SensorInformation:
    """Information (columns, columns) of all sensors together, and what of it is lost without each.

    `torques`: by place among the robot's joints; `wrenches`: by contact, with all its measured components.
    """

    total: Array
    torques: Mapping[int, Array]
    wrenches: Mapping[int, Array]


@torch.no_grad()
def sensor_information(
    logs: Sequence[Samples], builder: RowBuilder, most: int = SAMPLES, done: Callable[[int], None] | None = None
) -> SensorInformation:
    """Information of some logs in the builder's columns, and what of it hangs on each sensor.

    A sensor enters the generalized force of a sample by `C^T` times its reading, C (c, nv). Whatever it tells is what
    the whitened rows `W^T K` hold in the span of `W^T C^T`: without it, `W W^T` loses that and no more.

    Args:
        logs: bound logs.
        builder: of their rows.
        most: samples, about, that stand for all.
        done: called with the number of samples worked through.
    """
    joints = np.flatnonzero(builder.sensors.torque).tolist()
    components = measured_components(builder.contacts, builder.sensors)
    contacts = np.flatnonzero(components.any(axis=1)).tolist()
    count, base = builder.columns.count, builder.tree.base_rows
    total = torch.zeros(1 + len(joints) + len(contacts), count, count, dtype=torch.float64, device=builder.device)
    for samples, state, stands_for in _spread(logs, most):
        weight = stands_for / samples.oversampling
        rows, W = builder.rows_by_sample(samples.to(builder.device), state)
        K = rows[..., :-1]
        total[0] += weight * (flat := K.flatten(0, 1)).T @ flat
        ways = W[:, [base + joint for joint in joints]]  # (B, joints, nv)
        size = torch.linalg.vector_norm(ways, dim=2, keepdim=True)
        least = DEPENDENT * torch.linalg.matrix_norm(W)[:, None, None]
        lost = (torch.where(size > least, ways / size, 0.0) @ K).transpose(0, 1)  # (joints, B, columns)
        total[1 : 1 + len(joints)].baddbmm_(lost.mT, lost, alpha=weight)
        if any(state[contact] for contact in contacts):
            J = builder.contact_jacobian(samples.to(builder.device))
            for place, contact in enumerate(contacts, start=1 + len(joints)):
                if state[contact]:
                    C = J[:, contact, np.flatnonzero(components[contact]).tolist()]
                    total[place] += weight * (flat := (_span(C, W) @ K).flatten(0, 1)).T @ flat
        if done is not None:
            done(len(samples))
    found = total.cpu().numpy()
    wrenches = dict(zip(contacts, found[1 + len(joints) :], strict=True))
    return SensorInformation(found[0], dict(zip(joints, found[1:], strict=False)), wrenches)


def _spread(logs: Sequence[Samples], most: int) -> Iterator[tuple[Samples, State, float]]:
    """Chunks of about `most` samples, evenly spread over contact states and logs, and how many each stands for."""
    states = {state for samples in logs for state, _ in by_state(samples)}
    for samples, state, stands_for in spread_by_state(logs, max(most // max(len(states), 1), 1)):
        for start in range(0, len(samples), _CHUNK):
            yield samples[start : start + _CHUNK], state, stands_for


def _span(C: Tensor, W: Tensor) -> Tensor:
    """Orthonormal rows, (B, c, nv), that span those of `C W`, zeros for dependent ones."""
    _, values, Vh = torch.linalg.svd(C @ W, full_matrices=False)
    least = DEPENDENT * torch.linalg.matrix_norm(C) * torch.linalg.matrix_norm(W)
    return Vh * (values > least[:, None])[..., None]


def _sensors(
    information: SensorInformation, directions: Array, builder: RowBuilder, joint_names: Sequence[str]
) -> list[SensorContribution]:
    def known(H: Array) -> Knowledge:
        return Knowledge.of(np.asarray(np.linalg.eigvalsh(directions.T @ H @ directions)))

    everything, out = known(information.total), []
    frames = [contact.frame for contact in builder.contacts]
    for kind, names, lost in (
        ("joint torque", joint_names, information.torques),
        ("contact wrench", frames, information.wrenches),
    ):
        for place, H in lost.items():
            gone = everything - known(information.total - H)
            out.append(SensorContribution(names[place], gone.bits, gone.determined, kind))
    return sorted(out, key=lambda found: -found.bits)
