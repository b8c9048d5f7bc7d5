"""Base parameters and ranks, of logs and of all motions that contact states allow: what sensors can determine."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain
from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from torchid import parameters
from torchid.errors import BaseLostError, BaseLostWarning, NumericalWarning, UrdfError, format_percent, join_names, warn
from torchid.parallel import one_thread
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.problem import LinearProblem, RowBuilder, Samples, compress, linear_problem
from torchid.problem.chunks import chunks_by_state, subsample_states
from torchid.problem.contact_state import ContactState, state_name
from torchid.problem.metrics import null_space_components
from torchid.problem.motion import BaseMotion
from torchid.regressor import FrameJacobian, motion_from_state
from torchid.regressor.kinematics import (
    GRAVITY_WORLD,
    along_frame,
    body_states,
    frame_acceleration,
    joint_motion,
    rotation_matrix,
)
from torchid.regressor.loops import LoopClosures, LoopJacobian
from torchid.regressor.regressor import contact_arms
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.robot.tree import LOOPS_FIELD
from torchid.rounding import KINEMATIC_TOLERANCE, RANK_TOLERANCE, is_significant, numerical_rank
from torchid.sensing import Contact, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values

_ROUNDING = 1e-9  # of a coefficient between columns of norm 1; angles rounded to 1.5707963 give 1e-11
_LEAST_PREFERENCE = 1e-2  # between 1e-1 and 1e-4 sums are shortest; conditioning is the same
_CLEAR_GAP = 1e3  # least ratio of singular values at a clear rank; on exact motions it is 1e14
_CHECKED = 512  # samples per state, from all over the logs: shares are then accurate to about 2 %
_MOST = 0.5  # share of the samples that must have the whole base: else the median of the smallest singular value is 0


class RankGap(NamedTuple):
    """Numerical rank, and the gap at it: the smallest singular value that counts over the next one."""

    rank: int
    gap: float


class BaseParameters(nn.Module):
    """Base parameters phi_B = G phi with `K phi = K_B phi_B` (eq. 11) for all rows K like those of their problem.

    Attributes:
        kept: (P_B,) int, ascending; base parameter i is parameter `kept[i]` plus the parameters regrouped into it.
        combination: G, (P_B, P): the identity in the kept columns, zero in columns that are not free.
        null_space: (P_free - P_B, P), directions h with K h = 0; `null_space / scale` is orthonormal.
        free: (P,) bool; the other parameters are constants, see `forward`.
        scale: (P,), of the problem.
        rank, gap, singular_values: of the columns scaled to norm 1, see `rank_and_gap`.
    """

    index: Tensor

    def __init__(
        self,
        kept: np.ndarray,
        combination: Array,
        free: np.ndarray,
        scale: Array,
        singular_values: Array,
        rank_gap: RankGap,
    ) -> None:
        """Use `base_parameters` to create one."""
        super().__init__()
        self.kept = kept
        self.combination = combination
        self.free = free
        self.scale = scale
        self.singular_values = singular_values
        self.rank, self.gap = rank_gap
        self.null_space = _null_space(kept, combination, free, scale)
        self.register_buffer("index", torch.from_numpy(kept), persistent=False)

    def extra_repr(self) -> str:
        """What `repr` says."""
        return f"{self.rank} base parameters from {len(self.free)} parameters ({int(self.free.sum())} free)"

    def forward(self, K: Tensor) -> Tensor:
        """K_B, (..., P_B), of a regressor K, (..., P).

        Parameters that are not free are not in phi_B: `K phi = K_B phi_B + K[..., ~free] @ phi[~free]`.
        """
        return K.index_select(-1, self.index)

    def reduce(self, phi: Array) -> Array:
        """Base parameters (..., P_B) of parameters (..., P)."""
        return phi @ self.combination.T

    def lift(self, phi_B: Array, nominal: Array) -> Array:
        """Parameters (..., P) nearest to `nominal`, (P,), in units of `scale`, with base parameters (..., P_B)."""
        step = np.zeros((*phi_B.shape[:-1], len(self.scale)))
        step[..., self.kept] = (phi_B - self.reduce(nominal)) / self.scale[self.kept]
        directions = self.null_space / self.scale
        return nominal + self.scale * (step - step @ directions.T @ directions)

    def reduce_problem(self, problem: LinearProblem) -> LinearProblem:
        """The same problem in the base parameters, all free and observable. Constants move to the right-hand side.

        Raises:
            ValueError: the problem has other free parameters.
        """
        if not np.array_equal(problem.free, self.free):
            raise ValueError("free: found other free parameters than in these base parameters; accepted: the same")
        constant = np.where(self.free, 0.0, problem.nominal)
        return replace(
            problem,
            A=problem.A[:, self.kept],
            b=problem.b - problem.A @ constant,
            nominal=self.reduce(problem.nominal),
            scale=problem.scale[self.kept],
            free=np.ones(len(self.kept), dtype=bool),
        )


@one_thread()
def base_parameters(
    problem: LinearProblem, tolerance: float = RANK_TOLERANCE, preference: Array | None = None
) -> BaseParameters:
    """Find the parameter combinations that the rows of a problem depend on (base parameters), and their null space.

    Columns are scaled to norm 1, so a finger's inertia counts as much as the torso's mass. A pivoted QR factorization
    of the null space decides which parameters are regrouped into others.

    Source: Gautier, "Numerical calculation of the base inertial parameters of robots", 1991.

    Args:
        problem: with the rows.
        tolerance: a parameter is unobservable if its column (in units of `problem.scale`) is below this fraction of the
            largest; a singular value of the scaled columns below this fraction of the largest counts as zero.
        preference: (P,), > 0, preference for regrouping each parameter into others; by default
            `_regrouping_preference`.

    Warns:
        NumericalWarning: the rank depends on the tolerance.
    """
    free = np.flatnonzero(problem.free)
    count = len(problem.scale)
    columns, units = _normalized_columns(problem, tolerance)
    _, values, Vh = scipy.linalg.svd(columns, lapack_driver="gesvd")  # gesdd can fail on dozens of null directions
    rank_gap = rank_and_gap(values, tolerance)
    null_space = Vh[rank_gap.rank :].T
    weight = (_regrouping_preference(count) if preference is None else preference)[free]
    _, order = scipy.linalg.qr((null_space * weight[:, None]).T, mode="r", pivoting=True)
    null_dimension = len(free) - rank_gap.rank
    dropped = order[:null_dimension]
    kept = np.sort(order[null_dimension:])
    regrouped = -np.linalg.solve(null_space[dropped].T, null_space[kept].T).T
    regrouped[np.abs(regrouped) < _ROUNDING] = 0.0

    combination = np.zeros((len(kept), count))
    combination[np.arange(len(kept)), free[kept]] = 1.0
    combination[:, free[dropped]] = units[kept, None] * regrouped / units[dropped]
    return BaseParameters(free[kept], combination, problem.free, problem.scale, values, rank_gap)


def _regrouping_preference(count: int) -> Array:
    """Preference for regrouping each of `count` parameters into others, (count,), from 1 down to 0.01.

    As usual (Gautier, Khalil): bodies are regrouped into their parents; of a body the mass first, then first moments,
    then inertia.
    """
    bodies = max(count // parameters.PER_BODY, 1)
    return np.concatenate(np.array_split(np.geomspace(1.0, _LEAST_PREFERENCE, count), bodies)[::-1])


def format_base_parameters(base: BaseParameters, body_names: Sequence[str]) -> list[str]:
    """One formula per base parameter, such as `m[shank] + m[foot] - 0.31 Ixx[foot]`, coefficients in SI units.

    Args:
        base: in the parameters of bodies.
        body_names: of the L bodies, in order.
    """
    names = [f"{name}[{body}]" for body in body_names for name in PARAMETERS]
    lines = []
    for kept, row in zip(base.kept, base.combination, strict=True):
        others = [index for index in np.flatnonzero(row) if index != kept]
        lines.append("".join([names[kept], *(_term(row[index], names[index]) for index in others)]))
    return lines


def unobservable_parameters(base: BaseParameters, body_names: Sequence[str]) -> list[str]:
    """Free parameters in no base parameter, one line per body, such as `foot: Ixx, Ixy, Ixz, Iyy, Iyz, Izz`.

    Args:
        base: in the parameters of bodies.
        body_names: of the L bodies, in order.
    """
    unobservable = (base.free & ~base.combination.any(axis=0)).reshape(-1, PER_BODY)
    return [
        f"{body}: {', '.join(PARAMETERS[index] for index in np.flatnonzero(numbers))}"
        for body, numbers in zip(body_names, unobservable, strict=True)
        if numbers.any()
    ]


@one_thread()
def structural_rank(problem: LinearProblem) -> RankGap:
    """Rank of a problem's free columns, scaled to norm 1.

    Warns:
        NumericalWarning: the rank depends on the tolerance.
    """
    columns, _ = _normalized_columns(problem, RANK_TOLERANCE)
    return rank_and_gap(scipy.linalg.svd(columns, compute_uv=False, lapack_driver="gesvd"))


def rank_and_gap(values: Array, tolerance: float = RANK_TOLERANCE) -> RankGap:
    """Rank of a matrix with columns of similar size, and the gap to the next singular value.

    Values below rounding count as `eps` times the largest value, so the gap is at most 4.5e15.

    Args:
        values: singular values (P,), descending.
        tolerance: values below this fraction of the largest count as zero.

    Warns:
        NumericalWarning: the gap is below 1e3, so another tolerance gives another rank.
    """
    rank = numerical_rank(values, tolerance)
    if rank == 0:
        return RankGap(0, np.inf)
    dropped = max(float(values[rank]) if rank < len(values) else 0.0, np.finfo(float).eps * float(values[0]))
    gap = float(values[rank - 1]) / dropped
    if gap < _CLEAR_GAP:
        message = f"rank {rank} is not clear: the next singular value is only {gap:.3g} times smaller"
        warn(f"{message}. Another tolerance than {tolerance:g} gives another rank", NumericalWarning)
    return RankGap(rank, gap)


def _normalized_columns(problem: LinearProblem, tolerance: float) -> tuple[Array, Array]:
    """Free columns scaled to norm 1, (R, P_free), and their parameters' units, (P_free,).

    A column below the share `tolerance` of the largest, in units of `problem.scale`, is not observable, and set to 0.
    """
    scale = problem.scale[problem.free]
    columns = problem.A[:, problem.free] * scale
    norms = np.linalg.norm(columns, axis=0)
    observable = is_significant(norms, tolerance)
    norms[~observable] = 1.0
    return np.where(observable, columns, 0.0) / norms, scale / norms


def _null_space(kept: np.ndarray, combination: Array, free: np.ndarray, scale: Array) -> Array:
    """Null space of G in the free parameters, orthonormal in units of `scale`."""
    dropped = np.setdiff1d(np.flatnonzero(free), kept)
    directions = np.zeros((len(scale), len(dropped)))
    directions[dropped, np.arange(len(dropped))] = 1.0
    directions[kept] = -combination[:, dropped]
    basis = np.zeros((len(dropped), len(scale)))
    basis[:, free] = np.linalg.qr(directions[free] / scale[free, None]).Q.T * scale[free]
    return basis


def _term(coefficient: float, name: str) -> str:
    size = f"{abs(coefficient):.3g}"
    return f" {'-' if coefficient < 0 else '+'} {name if size == '1' else f'{size} {name}'}"


@dataclass(frozen=True)
class StateReport:
    """A contact state in the logs; entries on the base are None for a fixed base.

    Attributes:
        name: frames in contact, joined by "+".
        samples: number of samples.
        rows: equations per sample, at most.
        base_rank: rank(S_b V_x) that at least half of the samples checked reach.
        base_singular_value: median of its smallest singular value; near 0, base accelerations are nearly lost.
        base_full_share: share of the samples at rank 6.
        base_rank_shares: share at each rank that occurs, descending.
        mean_rows: equations per sample, on average, where torques of joints at rest count as unmeasured; else None. The
            base is judged as if no joint rested.
    """

    name: str
    samples: int
    rows: int
    base_rank: int | None
    base_singular_value: float | None
    base_full_share: float | None = None
    base_rank_shares: dict[int, float] = field(default_factory=dict)
    mean_rows: float | None = None


@one_thread()
@torch.no_grad()
def state_reports(logs: Sequence[Samples], builder: RowBuilder) -> list[StateReport]:
    """One report per contact state, most frequent first."""
    counts = Counter[ContactState]()
    for samples in logs:
        every = torch.arange(len(samples))
        for state, index in chunks_by_state(samples):
            counts[state] += len(every[index])
    rows = Counter[ContactState]()
    independent_rows = defaultdict[ContactState, float](float)
    values = defaultdict[ContactState, list[Tensor]](list)
    weights = defaultdict[ContactState, list[Tensor]](list)
    for samples, state, weight in subsample_states(logs, _CHECKED):
        kinematics = builder.kinematics(samples.to(builder.device))
        if samples.resting is not None:
            nothing = kinematics.screw_axes.new_zeros(1, len(samples), builder.tree.n_rows)
            for inside in null_space_components(builder, state, kinematics, nothing):
                independent_rows[state] += weight * float(torch.isfinite(inside).sum())
        for _, V in builder.null_space_bases(state, kinematics):
            rows[state] = max(rows[state], V.shape[2] + len(builder.layout(state).uncoupled_joints))
            if builder.tree.base_rows:
                values[state].append(base_singular_values(V).cpu())
                weights[state].append(torch.full((len(V),), weight))
    reports = [
        StateReport(
            state_name(builder.contacts, state),
            count,
            rows[state],
            *(_base_statistics(torch.cat(values[state]), torch.cat(weights[state])) if values[state] else (None, None)),
        )
        for state, count in counts.most_common()
    ]
    means = (
        independent_rows[state] / count if state in independent_rows else None for state, count in counts.most_common()
    )
    return [replace(report, mean_rows=mean) for report, mean in zip(reports, means, strict=True)]


def require_base(reports: Sequence[StateReport], on_base_lost: str = "error", contacts: Sequence[Contact] = ()) -> None:
    """Raise BaseLostError, or warn, if the projection loses a part of the base in a contact state.

    Args:
        reports: from `state_reports`.
        on_base_lost: "error" or "warn".
        contacts: all contacts; the message names the axes of line contacts.

    Raises:
        BaseLostError: a floating base loses rank in the projection.

    Warns:
        BaseLostWarning: the same, with "warn".
    """
    lost = [report for report in reports if report.base_rank is not None and report.base_rank < 6]
    if not lost:
        return
    where = "; ".join(f"{r.name} ({r.samples} samples): {_describe_rank(r)}" for r in lost[:4])
    message = f"sensors: the base is lost, rank(S_b V_x) < 6, in contact with {where}"
    touching = {frame for report in lost for frame in report.name.split(" + ")}
    lines = [f"{c.line_axis} of {c.frame}" for c in contacts if c.kind == "line" and c.frame in touching]
    if lines:
        message += f"; lines run along {join_names(lines)}, or set line_axis"
    if on_base_lost == "error":
        raise BaseLostError(f"{message}; accepted: more sensors, other contacts, or sensors.on_base_lost: warn")
    warn(f"{message}. These samples do not determine the parameters of some bodies", BaseLostWarning)


def _base_statistics(values: Tensor, weight: Tensor) -> tuple[int, float, float, dict[int, float]]:
    """Rank, median, share at rank 6 and shares by rank, from singular values (B, 6) of samples with weights (B,)."""
    ranks = base_rank(values)
    shares = {int(rank): float(weight[ranks == rank].sum() / weight.sum()) for rank in ranks.unique().flip(0)}
    return _common_rank(shares), float(values[:, -1].median()), shares.get(6, 0.0), shares


def merge_state_reports(of_logs: Iterable[Sequence[StateReport]]) -> list[StateReport]:
    """Merge reports of several logs, most frequent first; singular values are medians over the logs."""
    by_name: dict[str, list[StateReport]] = {}
    for report in chain.from_iterable(of_logs):
        by_name.setdefault(report.name, []).append(report)
    return sorted(map(_merged, by_name.values()), key=lambda report: -report.samples)


def _merged(same: Sequence[StateReport]) -> StateReport:
    """Merge the reports of one contact state from several logs."""
    samples = sum(report.samples for report in same)
    shares = defaultdict[int, float](float)
    for report in same:
        for rank, share in report.base_rank_shares.items():
            shares[rank] += share * report.samples / samples
    ranks = dict(sorted(shares.items(), reverse=True))
    values = sorted((report.base_singular_value or 0.0, report.samples) for report in same)
    middle = sum(below <= samples / 2 for below in accumulate(count for _, count in values))
    means = [(state_report.samples / samples, state_report.mean_rows) for state_report in same]
    mean_rows = sum(share * mean for share, mean in means if mean is not None) if means[0][1] is not None else None
    merged = replace(same[0], samples=samples, rows=max(report.rows for report in same), mean_rows=mean_rows)
    if not ranks:
        return merged
    return replace(
        merged,
        base_rank=_common_rank(ranks),
        base_singular_value=values[middle][0],
        base_full_share=ranks.get(6, 0.0),
        base_rank_shares=ranks,
    )


def _common_rank(shares: Mapping[int, float]) -> int:
    """The rank that at least half of the samples reach, from shares by rank, descending."""
    return next(rank for rank, so_far in zip(shares, accumulate(shares.values()), strict=True) if so_far >= _MOST)


def _describe_rank(report: StateReport) -> str:
    """Rank of most samples, and the share of samples with rank 6."""
    share = f", rank 6 in {format_percent(report.base_full_share)} % of them" if report.base_full_share else ""
    return f"rank {report.base_rank} of 6{share}"


# largest joint position [rad], [m]
_ANGLE = 1.5
_STROKE = 0.3
_ASSEMBLY = 0.3  # of random postures: from there the loops are closed for the first time
_PATH = 10  # steps from one posture to another
_REGULAR = 0.1  # of the least singular value of a loop Jacobian where it is largest, what must be left of it elsewhere
_LEAST_SHARE = 0.01  # of the way to a random posture, to which a path is cut short
_SAMPLES_PER_COLUMN = 2  # per state: a sample gives at least one row, and some directions are rarely excited
_WEIGHTLESS = (0.0, 0.0, 0.0)
# that turn soles along the ground, and the longest of them [rad]
_SOLE_STEPS = 30
_SOLE_STEP = 1.0
_SOLE_RTOL = 1e-3  # of singular values of these steps: two of three directions of each sole count
_AT_REST = 1e-10  # a projected velocity below this share of the drawn one is rounding and has no sign


def structural_problem(
    robot: Robot,
    contacts: Sequence[Contact],
    sensors: SensorSet,
    states: Sequence[ContactState],
    friction: bool = True,
    samples: Sequence[Samples] | None = None,
) -> LinearProblem:
    """Linear problem of random motions in given contact states, with right-hand side 0.

    Its rank is an upper bound for the rank of any log.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        sensors: which forces are measured.
        states: contact states of the robot.
        friction: whether friction is free.
        samples: random samples of these states, if already drawn.
    """
    builder = RowBuilder(robot, contacts, sensors)
    drawn = structural_samples(robot, contacts, states) if samples is None else samples
    factor = compress(drawn, builder, threads=1)  # a second one would wait for Python's lock, and takes a core
    return linear_problem(factor, builder, robot, friction)


def structural_samples(
    robot: Robot, contacts: Sequence[Contact], states: Sequence[ContactState], count: int | None = None, seed: int = 0
) -> list[Samples]:
    """Random samples, see `standing_samples`, of every contact state, for any sensor set.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        states: contact states the robot may be in.
        count: samples per state; by default twice the robot's base parameters, friction included.
        seed: of the random numbers.
    """
    count = count or _SAMPLES_PER_COLUMN * (10 + 9 * (len(robot.bodies) - 1))
    rng = np.random.default_rng(seed)
    return [standing_samples(robot, contacts, state, count, rng) for state in states]


def standing_samples(
    robot: Robot, contacts: Sequence[Contact], state: ContactState, count: int, rng: np.random.Generator
) -> Samples:
    """Random samples that satisfy the constraints of a contact state; forces are zeros.

    The ground differs between samples, so the rank is an upper bound for one ground. Points and lines stand on any
    slope. Flat feet of a floating base stand along their contacts' normals, so gravity has a constant direction in
    their frames. A fixed base has the pose of the robot.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        state: which of them touch the ground.
        count: number N of samples.
        rng: random number generator.
    """
    q, v, a = standing_states(robot, contacts, state, count, rng)
    rows = robot.base_rows
    base = BaseMotion.from_coordinates(q, v, a, robot.fixed_base)
    return Samples(
        source="standing samples",
        time=torch.arange(count, dtype=torch.float64),
        joint_position=q[:, q.shape[1] - robot.n :],
        joint_velocity=v[:, rows:],
        joint_acceleration=a[:, rows:],
        base=base.tilted(robot.base_tilt, count) if robot.fixed_base else base,
        torque=q.new_zeros(count, robot.n_dofs),
        wrench=q.new_zeros(count, len(contacts), 6),
        wrench_in_world=False,
        active=torch.tensor(state, dtype=torch.bool).expand(count, len(contacts)),
    )


@one_thread()
@torch.no_grad()
def standing_states(
    robot: Robot, contacts: Sequence[Contact], state: ContactState, count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates q (B, n + 7), v, a (B, nv), as `Regressor` takes them, with `J_C v = 0`, `J_C a + dJ_C/dt v = 0`.

    J_C has the components that active contacts can transmit: a point fixes its frame's origin, a flat contact the whole
    frame, a line all but the rotation about itself; with a radius, they roll. Closed loops have rows too. Twice as many
    states are drawn, and those nearest to a singular J_C are dropped, because accelerations are unbounded there. The
    axis of a flat foot that is nearest to upward at joint positions of 0 is along the normal (not for robots with
    loops).

    Raises:
        UrdfError: the loops do not close.
    """
    q, v, a = _random_states(robot, 2 * count, rng)
    constrained = [contact for contact, active in zip(contacts, state, strict=True) if active]
    soles = [contact for contact in constrained if contact.kind == "flat"]
    if soles and not robot.fixed_base and not robot.loops:
        q = _stand_on_soles(robot, soles, q)
    rows = [
        FrameJacobian(robot, contact.frame, contact.radius, contact.rolling_axis, contact.centre)(
            q, q.new_tensor(contact.normal)
        )[:, list(contact.components), : robot.nv]
        for contact in constrained
    ]
    if robot.loops:
        rows.append(LoopJacobian(robot)(q)[..., : robot.nv])
    J = torch.cat([q.new_zeros(len(q), 0, robot.nv), *rows], dim=1)
    if not rows:
        return q[:count], v[:count], a[:count]
    values = torch.linalg.svdvals(J)
    regular = values > KINEMATIC_TOLERANCE * values[:, :1]
    smallest = torch.where(regular, values, torch.inf).amin(1) / values[:, 0]
    best = torch.argsort(smallest, descending=True)[:count]
    q = q[best]
    v = v[best]
    a = a[best]
    J = J[best]
    inverse = torch.linalg.pinv(J, rtol=KINEMATIC_TOLERANCE)
    v = _in_null_space(v, inverse, J)
    v = torch.where(v.abs() < _AT_REST, 0.0, v)
    drift = _drift(robot, constrained, q, v)
    return q, v, _in_null_space(a, inverse, J) - (inverse @ drift[..., None])[..., 0]


def resting_samples(joint_position: Array, state: ContactState) -> Samples:
    """Samples of an upright robot at rest, at joint positions (N, n) [rad or m] in a contact state, without forces."""
    q = torch.from_numpy(np.ascontiguousarray(joint_position, dtype=float))
    still = torch.zeros_like(q)
    base = q.new_zeros(len(q), 3)
    upright, gravity = (q.new_tensor(x).expand(len(q), -1) for x in ((0.0, 0.0, 0.0, 1.0), GRAVITY_WORLD))
    return Samples(
        source="postures",
        time=q.new_zeros(len(q)),
        joint_position=q,
        joint_velocity=still,
        joint_acceleration=still,
        base=BaseMotion(upright, -gravity, base, base),
        torque=None,
        wrench=None,
        wrench_in_world=False,
        active=torch.tensor(state, dtype=torch.bool).expand(len(q), len(state)),
    )


def random_postures(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n), uniform, up to 1.5 rad or 0.3 m either way; or near these, where loops are closed.

    Raises:
        UrdfError: as `closed_postures`.
    """
    slides = (robot.joint_map[0] != 0.0).T @ robot.geometry.prismatic[1:]
    drawn: Array = np.where(slides, _STROKE, _ANGLE) * rng.uniform(-1.0, 1.0, (count, robot.n))
    return closed_postures(robot, drawn) if robot.loops else drawn


def closed_postures(robot: Robot, postures: Array) -> Array:
    """Joint positions (N, n) at which the loops of a robot are closed, near given ones where there are any.

    All are reached from one posture, that nearest to joint positions of 0, on paths that keep the loops closed and away
    from singular postures: beyond these a mechanism could have been assembled otherwise. Paths that fail are cut short.

    Raises:
        UrdfError: loops that close nowhere near joint positions of 0.
    """
    closures = LoopClosures(robot)
    steps = torch.from_numpy(postures) / _PATH
    zero = torch.zeros(1, robot.n, dtype=torch.float64)
    positions, closed = closures.closed(torch.cat([zero, _ASSEMBLY * torch.from_numpy(postures)]))
    if not closed.any():
        size = float(closures.deviations(zero).abs().max())
        text = f"loops are open by {size:.3g} m or rad at joint positions of 0 and do not close near there"
        raise UrdfError(robot.path, LOOPS_FIELD, text, "loop frames that coincide at some joint positions near 0")
    positions = positions[closed]
    positions = positions[positions.abs().amax(1).argsort()]
    values = torch.linalg.svdvals(closures.jacobian(positions))
    rank = int((values > KINEMATIC_TOLERANCE * values[:, :1]).sum(1).max())
    least = _REGULAR * float(values[:, rank - 1].max())
    assembled = positions[values[:, rank - 1] > least][:1]
    out = assembled.repeat(len(postures), 1)
    remaining = torch.arange(len(postures))
    share = 1.0
    while len(remaining) and share > _LEAST_SHARE:
        q = assembled.repeat(len(remaining), 1)
        kept = torch.ones(len(remaining), dtype=torch.bool)
        for _ in range(_PATH):
            q, closed = closures.closed(q + share * steps[remaining])
            kept &= closed & (torch.linalg.svdvals(closures.jacobian(q))[:, rank - 1] > least)
        out[remaining[kept]] = q[kept]
        remaining = remaining[~kept]
        share = share / 2.0
    return np.asarray(out.numpy())


def _stand_on_soles(robot: Robot, soles: Sequence[Contact], q: Tensor) -> Tensor:
    """Coordinates (B', n + 7) near others (B, n + 7) at which flat feet stand along their contacts' normals.

    Newton's steps on the base's orientation and the joints; of postures from which they do not lead there none is left.
    """
    jacobians = [FrameJacobian(robot, contact.frame) for contact in soles]
    upright = q.new_tensor([0.0] * 6 + [1.0] + [0.0] * robot.n)[None]
    upward = [J(upright)[0, :3, 2] for J in jacobians]  # of the base's z axis in the frames
    axes = [torch.where(up.abs() == up.abs().max(), up.sign(), 0.0) for up in upward]
    for _ in range(_SOLE_STEPS):
        rows = []
        wanted = []
        for contact, jacobian, axis in zip(soles, jacobians, axes, strict=True):
            J = jacobian(q)
            normal = q.new_tensor(contact.normal)
            normals = (J[:, :3, :3] @ (rotation_matrix(q[:, 3:7]).mT @ normal)[..., None])[..., 0]
            rows.append(torch.linalg.cross(normals[..., None], J[:, 3:, : robot.nv], dim=1))
            wanted.append(axis - normals)
        missing = torch.cat(wanted, dim=1)
        step = (torch.linalg.pinv(torch.cat(rows, dim=1), rtol=_SOLE_RTOL) @ missing[..., None])[..., 0]
        step = step * (_SOLE_STEP / step.norm(dim=1, keepdim=True).clamp(min=_SOLE_STEP))
        turned = Rotation.from_quat(q[:, 3:7].numpy()) * Rotation.from_rotvec(step[:, 3:6].numpy())
        q = torch.cat([q[:, :3], torch.from_numpy(turned.as_quat()), q[:, 7:] + step[:, 6:]], dim=1)
    return q[missing.abs().amax(1) < KINEMATIC_TOLERANCE]


def _in_null_space(x: Tensor, inverse: Tensor, J: Tensor) -> Tensor:
    """The part of x, (B, nv), in the null space of J; the second pass removes the rounding of the first."""
    for _ in range(2):
        x = x - (inverse @ (J @ x[..., None]))[..., 0]
    return x


def _random_states(robot: Robot, count: int, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
    q = random_postures(robot, count, rng)
    v = rng.normal(size=(count, robot.nv))
    a = 3.0 * rng.normal(size=(count, robot.nv))
    if not robot.fixed_base:
        q = np.hstack([np.zeros((count, 3)), Rotation.random(count, random_state=rng).as_quat(), q])
    return torch.from_numpy(q), torch.from_numpy(v), torch.from_numpy(a)


def _drift(robot: Robot, constrained: Sequence[Contact], q: Tensor, v: Tensor) -> Tensor:
    """dJ/dt v, (B, k): accelerations at a = 0 of contacts' constrained components, along their axes, and of loops."""
    tree = KinematicTree(robot)
    motion = motion_from_state(q, v, torch.zeros_like(v), robot.n, robot.fixed_base, _WEIGHTLESS)
    states = body_states(tree, motion, joint_motion(tree, motion))
    rows = []
    for contact in constrained:
        node, T_joint_frame = tree.frame(robot, contact.frame, contact.centre)
        normal = q.new_tensor(contact.normal).expand(len(q), 3)
        if not robot.fixed_base:
            normal = (rotation_matrix(q[:, 3:7]).mT @ normal[..., None])[..., 0]
        pose = v.new_tensor(T_joint_frame)
        arms = contact_arms(states, node, pose[:3, :3], contact.radius, normal.T, contact.rolling_axis)
        acceleration = frame_acceleration(states, node, pose, arms)
        rows.append(along_frame(states, node, pose, acceleration)[list(contact.components)])
    if robot.loops:
        joints = (x[:, x.shape[1] - robot.n :] for x in (q, v))
        rows.append(LoopClosures(robot).drift(*joints).T)
    return torch.cat(rows).T
