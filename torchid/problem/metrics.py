"""Measured and predicted generalized forces, and their errors by group of rows, compared with the nominal model."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.errors import format_percent, join_names
from torchid.logs.spill import Spill
from torchid.parallel import one_thread
from torchid.parameters import GRAVITY, MASS, Array
from torchid.problem.chunks import ProgressCallback, blocks_in, chunks_by_state, map_chunks
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import ACTUATORS, Extra, ExtraTerms, contact_extra_column, dof_extra_column
from torchid.problem.null_bases import leave_out_torques
from torchid.problem.rows import EVERY, Chunk, RowBuilder
from torchid.problem.samples import Samples
from torchid.regressor.regressor import friction_columns, generalized_forces, joint_row
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, named_sensors

_ROWS = 2**16  # of a log on disk that are in memory at a time
_NOISE_SAMPLES = 64  # of a chunk, for the noise of its measured forces


# ------------------------------------------------------------------------------------------------ calibrated readings


def calibrate_readings(samples: Samples, extras: Sequence[Extra], values: Array, tree: KinematicTree) -> Samples:
    """Samples with calibrated readings: s y - o for an offset o and a scale s of the reading y.

    Readings without extra parameters share the memory of `samples`; the others are on disk if `samples` are.

    Args:
        samples: as recorded.
        extras: of sensors; those of actuators are ignored.
        values: of each, (E,).
        tree: of the robot.

    Raises:
        SpillError: the disk is full.
    """
    calibration = [
        (x, value) for x, value in zip(extras, values.tolist(), strict=True) if x.what in ("offset", "scale")
    ]
    if samples.folder is None:
        return replace(samples, **_readings(samples, calibration, tree))
    spills: defaultdict[str, Spill] = defaultdict(partial(Spill, samples.source, samples.folder))
    for start in range(0, len(samples), _ROWS):
        for name, rows in _readings(samples[start : start + _ROWS], calibration, tree).items():
            spills[name].append(rows.numpy())
    stored: dict[str, Any] = {name: torch.from_numpy(spill.array()) for name, spill in spills.items()}
    return replace(samples, **stored)


def _readings(samples: Samples, calibration: Sequence[tuple[Extra, float]], tree: KinematicTree) -> dict[str, Any]:
    """Calibrated copies of the readings with extra parameters, by field."""
    copies: dict[str, Tensor] = {}
    for extra, value in calibration:
        name = "torque" if extra.dofs else "wrench"
        recorded: Tensor | None = getattr(samples, name)
        if recorded is None:
            continue
        if name not in copies:
            copies[name] = recorded.clone()
        copy = copies[name]
        for dof in extra.dofs:
            copy[:, dof] -= value * dof_extra_column(extra, dof, samples, tree)
        for contact, axis in extra.contacts:
            copy[:, contact, axis] -= value * contact_extra_column(extra, samples, contact, axis)
    return copies


# ------------------------------------------------------------------------------------------------- forces of a chunk


def predict_forces(builder: RowBuilder, chunk: Chunk, phi: Tensor) -> Tensor:
    """K phi, (M, n_rows, B), for M parameter vectors (M, columns) in the builder's columns, without extras.

    K is computed one row at a time. `chunk`: with whole wrenches.
    """
    tree = builder.tree
    columns = builder.columns
    inertial = columns.layout.count
    base = tree.base_rows
    out = phi.new_empty(tree.n_rows, len(phi), len(chunk))
    torch.matmul(phi[:, :inertial], chunk.wrenches[:base], out=out[:base])
    for row, forces in zip(columns.joint_rows, out[base:], strict=True):
        block = joint_row(row, tree, columns.layout, chunk.screw_axes, chunk.wrenches)
        torch.mm(phi[:, row.start : row.end], block, out=forces)
        for body, *friction in friction_columns(row, chunk.joints):
            at = columns.friction(body)
            forces.addmm_(phi[:, at : at + 2], torch.stack(friction))
    return out.transpose(0, 1)


def with_payload_columns(builder: RowBuilder, samples: Samples, phi: Tensor) -> Tensor:
    """Parameters (M, columns) in the builder's columns of a robot with the payload of some samples."""
    return phi if samples.payload is None else phi + builder.to_columns(samples.payload[None]).to(phi)


def _predicted(builder: RowBuilder, chunk: Chunk, phi: Tensor) -> Tensor:
    """Forces (M, B, n_rows) at parameters (M, width), with payloads, known torques and extras of actuators."""
    samples = chunk.samples
    base_rows = builder.tree.base_rows
    predicted = predict_forces(builder, chunk, with_payload_columns(builder, samples, phi)).mT
    if not builder.known_torques.none:
        predicted[..., base_rows:] += builder.known_torques.of(samples)
    for number, extra in enumerate(builder.extras, start=builder.columns.count):
        for dof in extra.dofs if extra.what in ACTUATORS else ():
            column = dof_extra_column(extra, dof, samples, builder.tree)
            predicted[..., base_rows + dof] += phi[:, number, None] * column
    return predicted


def _predicted_by_fold(builder: RowBuilder, chunk: Chunk, phi: Mapping[int, Tensor]) -> Tensor:
    """Forces (M, B, n_rows) at parameters (M, width) of each sample's fold."""
    parts = [
        _predicted(builder, chunk.select(slice(start, end)), phi[fold])
        for fold, _, start, end in blocks_in(chunk.samples)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def _joint_forces(builder: RowBuilder, chunk: Chunk) -> Tensor:
    """S^T tau, (B, n_rows) [N m], NaN where it was not measured."""
    return torch.nn.functional.pad(builder.recorded_torque(chunk.samples), (builder.tree.base_rows, 0))


def _contact_forces(builder: RowBuilder, chunk: Chunk, state: ContactState) -> Tensor:
    """J_C^T lambda, (B, n_rows), over the active contacts; NaN in the rows that an unmeasured component reaches."""
    tree = builder.tree
    total = chunk.screw_axes.new_zeros(tree.n_rows, len(chunk))
    for contact in np.flatnonzero(state).tolist():
        body, _ = builder.frames[contact]
        possible = list(builder.contacts[contact].components)
        components = builder.recorded_wrench(chunk, contact)[:, possible].T
        wrench = (builder.unit_wrenches(chunk, contact, possible) * components).sum(1, keepdim=True)
        joints = builder.columns.joints_above(body)  # other rows must not become NaN by an unmeasured force
        rows = builder.columns.rows_above(body)
        total[rows] += generalized_forces(tree, chunk.screw_axes, body, wrench, joints)[0]
    return total.T


def reading_variance(builder: RowBuilder, chunk: Chunk, state: ContactState, noise: SensorNoise) -> Tensor:
    """Variance of S^T tau + J_C^T lambda from the noise of the readings, (B, n_rows) [N^2, (N m)^2].

    The filter keeps the fraction `noise_left` of it. NaN where a reading, or its noise, is unknown.

    Args:
        builder: with all recorded sensors.
        chunk: samples of one contact state.
        state: that state.
        noise: standard deviations of the recorded readings, NaN where unknown.
    """
    tree = builder.tree
    std = noise.dof_std(tree.n, tree.n_dofs)
    std[list(builder.motors.passive)] = np.nan
    total = chunk.screw_axes.new_zeros(tree.n_rows, len(chunk))
    unknown = 0.0 * builder.recorded_torque(chunk.samples).T  # NaN where it was not recorded
    total[tree.base_rows :] = total.new_tensor(std**2)[:, None] + unknown
    for contact in np.flatnonzero(state).tolist():
        body, _ = builder.frames[contact]
        possible = list(builder.contacts[contact].components)
        wrenches = builder.unit_wrenches(chunk, contact, possible, noise.wrench_std)
        rows = builder.columns.rows_above(body)
        forces = total.new_zeros(len(possible), *total.shape)
        joints = builder.columns.joints_above(body)
        forces[:, rows] = generalized_forces(tree, chunk.screw_axes, body, wrenches, joints)
        total += builder.motors.of(tree, chunk.states, forces.mT).mT.square().sum(0)
        total[rows] += 0.0 * builder.recorded_wrench(chunk, contact)[:, possible].sum(1)
    return total.T * chunk.samples.noise_left


def centre_of_pressure(wrench: Tensor, normal: Tensor, height: Tensor, least: float = 0.0) -> Tensor:
    """Where a wrench (..., B, 6) at the base origin meets the ground, (..., B, 3) [m] from that origin.

    The ground's normal n, (B, 3), is in base axes, the base's height above it h, (B,). About the point p the moment is
    along n: p = (n x M - h F) / (n F). Undefined, NaN, where the force along n is at most `least` [N].

    Source: Sardain, Bessonnet, "Forces acting on a biped robot. Center of pressure - zero moment point", 2004.
    """
    force = wrench[..., :3]
    moment = wrench[..., 3:]
    across = torch.linalg.cross(normal.expand_as(moment), moment)
    carried = (force * normal).sum(-1, keepdim=True)
    return (across - height[:, None] * force) / carried.where(carried > least, torch.nan)


def _pressure_centres(builder: RowBuilder, chunk: Chunk, state: ContactState, wrench: Tensor, least: float) -> Tensor:
    """`centre_of_pressure` of wrenches (M, B, 6) on the mean plane of active contacts; NaN without any, or attitude."""
    active = np.flatnonzero(state).tolist()
    rotation = chunk.rotation
    recorded = chunk.samples.contact_normal
    if rotation is None or not active:
        return torch.full_like(wrench[..., :3], torch.nan)
    normals = (builder.normals[active].to(wrench) if recorded is None else recorded[:, active]) @ rotation
    radii = wrench.new_tensor([builder.contacts[contact].radius for contact in active])
    points = []
    for contact in active:
        node = builder.frames[contact][0]
        origin = builder.frame_origin[contact]
        points.append(chunk.states.position[:, node] + origin @ chunk.states.rotation[:, :, node])
    soles = torch.stack(points).permute(2, 0, 1) - radii[:, None] * normals
    normal = torch.nn.functional.normalize(normals.mean(1), dim=1)
    return centre_of_pressure(wrench, normal, -(soles @ normal[..., None]).mean((1, 2)), least)


def null_space_components(builder: RowBuilder, state: ContactState, chunk: Chunk, vectors: Tensor) -> Iterator[Tensor]:
    """V_x^T of generalized forces (M, B, n_rows), V_x the contacts' null space, in groups of one rank, (M, B', r).

    Joints away from contacts are unchanged. NaN where joints at rest leave the force unknown.
    """
    layout = builder.layout(state)
    base = builder.tree.base_rows
    coupled = [*range(base), *(base + joint for joint in layout.coupled_joints)]
    uncoupled = [base + joint for joint in layout.uncoupled_joints]
    resting = builder.coupled_at_rest(layout, chunk)
    alone = chunk.without_rest(vectors, base)[..., uncoupled]
    vectors = chunk.without_rest(vectors, base, 0.0)
    for index, V in builder.null_space_bases(state, chunk):
        if resting is not None:
            V = V.clone()
            leave_out_torques(V.permute(1, 2, 0), resting[:, index])
        # contiguous, as products of other layouts take ten times as long
        by_sample = vectors[:, index].permute(1, 2, 0)[:, coupled].contiguous()
        inside = (V.mT.contiguous() @ by_sample).permute(2, 0, 1)
        if resting is not None:
            inside = inside.masked_fill(~V.any(1), torch.nan)
        yield torch.cat([inside, alone[:, index]], dim=2)


# --------------------------------------------------------------------------------------------------- series of a log

_Where = slice | np.ndarray


@one_thread()
@torch.no_grad()
def _series(
    builder: RowBuilder,
    samples: Samples,
    compute: Callable[[Samples, ContactState, _Where], Sequence[Tensor]],
) -> list[Array]:
    """Arrays (..., N, columns) of a log in its order.

    Args:
        builder: on whose device they are computed.
        samples: of the log.
        compute: (..., B, columns) each, of samples of one contact state on that device, and where in the log's order
            these belong.
    """
    out: list[Array] = []
    for state, index in chunks_by_state(samples) if len(samples) else [((False,) * len(builder.contacts), EVERY)]:
        where = index if isinstance(index, slice) else index.numpy()
        parts = compute(samples[index].to(builder.device), state, where)
        out = out or [np.empty((*part.shape[:-2], len(samples), part.shape[-1])) for part in parts]
        for series, part in zip(out, parts, strict=True):
            series[..., where, :] = part.cpu().numpy()
    return out


def noise_series(builder: RowBuilder, samples: Samples, noise: SensorNoise) -> Array:
    """Standard deviation of the measured forces of a log in its order by `reading_variance`, (N, n_rows) [N, N m]."""

    def compute(part: Samples, state: ContactState, _: _Where) -> list[Tensor]:
        return [reading_variance(builder, builder.kinematics(part), state, noise).sqrt()]

    return _series(builder, samples, compute)[0]


def force_series(builder: RowBuilder, samples: Samples, phi: Array) -> tuple[Array, Array]:
    """Measured (N, n_rows) and predicted (M, N, n_rows) forces of a log in its order, `phi` as for `to_columns`.

    Measured forces, S^T tau + J_C^T lambda [N, N m], are NaN where a part was not measured. Sensors count as
    calibrated: only extras of actuators enter.
    """
    columns = builder.to_columns(phi)
    workspace = builder.workspaces.take()

    def compute(part: Samples, state: ContactState, _: _Where) -> list[Tensor]:
        chunk = builder.dynamics(part, workspace, whole=True)
        measured = _joint_forces(builder, chunk) + _contact_forces(builder, chunk, state)
        return [measured, _predicted(builder, chunk, columns)]

    measured, predicted = _series(builder, samples, compute)
    builder.workspaces.give_back(workspace)
    return measured, predicted


def pressure_series(builder: RowBuilder, samples: Samples, wrenches: Array, least: float) -> Array:
    """`centre_of_pressure` on the feet of wrenches (M, N, 6) of a log in its order, (M, N, 3) [m]."""

    def compute(part: Samples, state: ContactState, where: _Where) -> list[Tensor]:
        wrench = torch.from_numpy(wrenches[:, where]).to(part.time)
        return [_pressure_centres(builder, builder.kinematics(part), state, wrench, least)]

    return _series(builder, samples, compute)[0]


def null_space_part(builder: RowBuilder, samples: Samples, forces: Array) -> Array:
    """V_x V_x^T f of generalized forces (M, N, n_rows): the part of each row inside the builder's null space."""
    base = builder.tree.base_rows

    def compute(part: Samples, state: ContactState, where: _Where) -> list[Tensor]:
        f = torch.from_numpy(forces[:, where]).to(part.time, copy=True)
        coupled = [*range(base), *(base + joint for joint in builder.layout(state).coupled_joints)]
        for index, V in builder.null_space_bases(state, builder.kinematics(part)):
            inside = f[:, index]
            inside[..., coupled] = (V @ (V.mT @ inside[..., coupled, None]))[..., 0]
            f[:, index] = inside
        return [f]

    return _series(builder, samples, compute)[0]


def at_motors(builder: RowBuilder, samples: Samples, forces: Array) -> Array:
    """Generalized forces of a log in its order, (M, N, n_rows), as the motors of closed loops feel them."""
    if builder.motors.none:
        return forces

    def compute(part: Samples, state: ContactState, where: _Where) -> list[Tensor]:
        f = torch.from_numpy(forces[:, where]).to(part.time)
        return [builder.motors.of(builder.tree, builder.kinematics(part).states, f)]

    return _series(builder, samples, compute)[0]


def torque_series(builder: RowBuilder, samples: Samples, predicted: Array) -> tuple[Array, Array]:
    """Measured joint torques (N, n_rows) and predicted ones (M, N, n_rows) of a log in its order [N m], base rows 0.

    The predicted torques contain the contact forces that explain the measured torques best, in least squares: no
    contact force need be measured. `predicted`: K phi of `force_series`.
    """

    def compute(part: Samples, *_: object) -> list[Tensor]:
        return [torch.nn.functional.pad(builder.recorded_torque(part), (builder.tree.base_rows, 0))]

    (torque,) = _series(builder, samples, compute)
    return torque, torque + null_space_part(builder, samples, predicted - torque)


def torque_noise_series(builder: RowBuilder, samples: Samples, noise: SensorNoise) -> Array:
    """Standard deviation of the errors of `torque_series` by the noise of the torques, (N, n_rows) [N m]."""
    step = -(-len(samples) // _NOISE_SAMPLES)  # it hardly changes
    few = samples.every(step)
    base = builder.tree.base_rows
    std = noise.dof_std(builder.tree.n, builder.tree.n_rows - base)
    units = np.pad(np.diag(std), ((0, 0), (base, 0)))[:, None].repeat(len(few), axis=1)
    variance = np.square(null_space_part(builder, few, units)).sum(axis=0) * few.noise_left
    return np.sqrt(variance).repeat(step, axis=0)[: len(samples)]


# -------------------------------------------------------------------------------------------------- sums of squares

WHITENED = "projected_residual"
"""Group of the fit's rows: whitened and projected."""

ROW_GROUPS = {
    "joint_torque": "joint torque [N m]",
    "base_force": "base force [N]",
    "base_moment": "base moment [N m]",
    "nullspace": "projected force [N, N m]",
}
"""Groups of rows with errors, with a name and unit to show."""

ERROR_GROUPS = ROW_GROUPS | {WHITENED: "residual [x noise]"}
"""The same, and the whitened projected residual of a fit's rows, which every sensor set has."""

IN_AIR = "limbs in the air"  # only their joint torques count if no contact force was measured

LIMB_GROUPS = {"ft_force": "force in limbs [N]", "ft_moment": "moment in limbs [N m]"}
"""Groups of readings of force/torque sensors in limbs."""

PRESSURE = "centre_of_pressure"
PRESSURE_GROUP = {PRESSURE: "centre of pressure [m]"}
"""The centre of pressure, where the ground carries at least a tenth of the weight."""

_LABELS = ERROR_GROUPS | LIMB_GROUPS | PRESSURE_GROUP
_BESIDE_ROWS = ("nullspace", WHITENED, PRESSURE)  # groups of one number each, after the rows of K in sums
_VECTORS = ("base_force", "base_moment", *LIMB_GROUPS)  # groups with three axes

LOG_SETS = ("train", "test")
"""Sets of logs with errors."""

BASE_ROWS = tuple(f"base {kind} {axis}" for kind in ("force", "moment") for axis in "xyz")
"""Names of the six base rows."""

DECISIVE_GROUPS = ("joint_torque", "base_force", "base_moment", *LIMB_GROUPS, WHITENED)
"""Groups of rows that decide whether parameters are better than the nominal ones."""

ADVICE = (
    "Do not use these parameters. Run torchid check on the same file, raise estimator.ridge above that of config.yaml, "
    "or record more varied motion."
)
"""Advice for parameters that predict worse than the nominal ones."""

_CARRIES = 0.1  # fraction of the weight; with less force there is no meaningful centre of pressure
_CLEARLY = 1.05  # ratio of errors that counts as worse
_MATTERS = 1e-3  # fraction of the measured rms; smaller differences do not count


class SumsOfSquares:
    """Sums and sums of squares over samples in which a number is finite: of the rows of K, then of `_BESIDE_ROWS`."""

    def __init__(self, n_rows: int) -> None:
        self.sum, self.squares, self.count = np.zeros((3, n_rows + len(_BESIDE_ROWS)))

    def add(self, x: Tensor, group: str = "", weight: float = 1.0) -> None:
        """Add numbers, NaN where unknown, each of which counts as `weight` of them.

        Args:
            x: of samples, (N, n_rows); of a group beside the rows of any shape.
            group: name of that group.
            weight: of each.
        """
        values = x.cpu().numpy()
        values = values.reshape(-1, 1) if group else values
        at = [_BESIDE_ROWS.index(group) - len(_BESIDE_ROWS)] if group else slice(-len(_BESIDE_ROWS))
        known = np.isfinite(values)
        if not known.all():
            values = np.where(known, values, 0.0)
        self.sum[at] += weight * values.sum(0)
        self.squares[at] += weight * np.einsum("ij,ij->j", values, values)
        self.count[at] += weight * known.sum(0)

    def add_squares(self, squares: float, count: float) -> None:
        """Add the sum of squares of so many whitened rows of a fit; their sum stays unknown."""
        at = _BESIDE_ROWS.index(WHITENED) - len(_BESIDE_ROWS)
        self.squares[at] += squares
        self.count[at] += count

    def rms(self, at: Sequence[int]) -> float:
        """Rms over all of some numbers, NaN of nothing."""
        count = self.count[at].sum()
        return float(np.sqrt(self.squares[at].sum() / count)) if count else np.nan

    def deviation(self, at: Sequence[int]) -> float:
        """Rms of each of some numbers about its mean, over all of them."""
        known = [number for number in at if self.count[number] > 0]
        if not known:
            return np.nan
        count = self.count[known]
        variance = (self.squares[known] - self.sum[known] ** 2 / count).sum() / count.sum()
        return float(np.sqrt(max(variance, 0.0)))

    def merge(self, other: SumsOfSquares) -> None:
        """Add the sums of another."""
        self.sum += other.sum
        self.squares += other.squares
        self.count += other.count


class ForceSums:
    """Sums of squares of generalized forces or their errors; of the measured ones also what noise of readings adds.

    `contact_forces`: whether one that was not measured enters joint rows, which do not count, and whether a measured
    one enters rows that do.
    """

    def __init__(self, n_rows: int) -> None:
        self.forces = SumsOfSquares(n_rows)
        self.noise = SumsOfSquares(n_rows)
        self.contact_forces = np.zeros(2, dtype=bool)

    @classmethod
    def total(cls, parts: Sequence[ForceSums]) -> ForceSums:
        """Sums over all parts."""
        out = cls(len(parts[0].forces.sum) - len(_BESIDE_ROWS))
        for part in parts:
            out.forces.merge(part.forces)
            out.noise.merge(part.noise)
            out.contact_forces |= part.contact_forces
        return out

    def add_contact_forces(self, measured: Tensor, torque: Tensor) -> None:
        """Note those in measured joint rows J_C^T lambda + tau, (B, n), NaN where one is not known."""
        lost = measured.isnan() & torque.isfinite()
        known = measured.isfinite() & (measured != torque)
        self.contact_forces |= [bool(lost.any()), bool(known.any())]


def _group_places(robot: Robot) -> dict[str, list[int]]:
    """Where groups are in `SumsOfSquares`, and their parts: "joint_torque.l_knee", "base_force.x"."""
    base = robot.base_rows
    n = robot.n
    places = {"joint_torque": list(range(base, base + n))}
    vectors = {"base_force": [0], "base_moment": [3]} if base else {"base_force": [], "base_moment": []}
    if robot.ft_names:
        limbs = range(base + n, robot.n_rows, 6)
        vectors |= {"ft_force": list(limbs), "ft_moment": [first + 3 for first in limbs]}
    for group, first in vectors.items():
        places[group] = [row + axis for row in first for axis in range(3)]
    places |= {group: [number - len(_BESIDE_ROWS)] for number, group in enumerate(_BESIDE_ROWS)}
    places |= {f"joint_torque.{name}": [base + joint] for joint, name in enumerate(robot.joint_names)}
    for group, first in vectors.items():
        places |= {f"{group}.{axis}": [row + k for row in first] for k, axis in enumerate("xyz") if first}
    return places


def _all_rms(sums: SumsOfSquares, places: Mapping[str, list[int]]) -> dict[str, float]:
    """Rms of all groups and parts; of joint torques the mean over joints of theirs."""
    rms = {name: sums.rms(at) for name, at in places.items()}
    joints = [x for name, x in rms.items() if name.startswith("joint_torque.") and np.isfinite(x)]
    return rms | {"joint_torque": float(np.mean(joints)) if joints else np.nan}


@dataclass(frozen=True, repr=False)
class Metrics:
    """Prediction errors of one parameter vector on logs; None where the logs do not give a number.

    Attributes:
        rms: by group of `ERROR_GROUPS`, `LIMB_GROUPS` (limb sensors) and `PRESSURE` (where contact forces are measured
            and carry a tenth of the weight). "joint_torque" is the mean over joints of their rms. The whitened group is
            in units of the stated noise.
        relative: the same, divided by the rms of the measurement.
        part_rms: rms of single joints and axes, such as "joint_torque.l_knee" or "base_force.x" (axes of the base link,
            or of the sensor frame, all limb sensors together).
        part_relative: the same, divided by the rms of the measurement.
        base_force_of_variation: error of the base force divided by the rms of the measured force about its mean (mostly
            weight).
        noise: by group, rms of the stated sensor noise after the filter, the noise floor; None where unknown.
        limbs_in_air: whether joint torques count only for limbs in the air, because no contact force was measured.
    """

    rms: dict[str, float | None]
    relative: dict[str, float | None]
    part_rms: dict[str, float | None]
    part_relative: dict[str, float | None]
    base_force_of_variation: float | None
    noise: dict[str, float | None] = field(default_factory=dict)
    limbs_in_air: bool = False

    def rms_of(self, group: str) -> float | None:
        """Rms error of a group; None if unknown."""
        return self.rms.get(group)

    def relative_of(self, group: str) -> float | None:
        """Rms error of a group divided by the rms of the measurement; None if unknown."""
        return self.relative.get(group)

    @property
    def by_joint_rms(self) -> dict[str, float | None]:
        """Rms error of the torque by joint name [N m or N]."""
        return _parts_of(self.part_rms, "joint_torque")

    @property
    def by_joint_relative(self) -> dict[str, float | None]:
        """Rms error of the torque by joint name, divided by the rms of the measurement."""
        return _parts_of(self.part_relative, "joint_torque")

    def label(self, group: str) -> str:
        """Name and unit of a group, with its restriction to limbs in the air."""
        limit = f", {IN_AIR} [" if self.limbs_in_air and group == "joint_torque" else " ["
        return _LABELS[group].replace(" [", limit)

    def __repr__(self) -> str:
        said = []
        for group in ERROR_GROUPS:
            rms = self.rms.get(group)
            share = self.relative.get(group)
            if rms is not None:
                name, _, unit = self.label(group).rstrip("]").partition(" [")
                said.append(f"{name} {rms:.3g} {unit}" + ("" if share is None else f" ({format_percent(share)} %)"))
        return f"Metrics: {', '.join(said) or 'none'}"

    def as_dict(self) -> dict[str, object]:
        """Content of `metrics.json`."""
        out: dict[str, object] = {}
        for suffix, groups, parts in (("", self.rms, self.part_rms), ("_relative", self.relative, self.part_relative)):
            for group in LIMB_GROUPS:
                if group in groups:
                    out[f"{group}_rms{suffix}"] = groups[group]
            for group in _VECTORS:
                if axes := _parts_of(parts, group):
                    out[f"{group}_rms_by_axis{suffix}"] = axes
            for group in ROW_GROUPS:
                out[f"{group}_rms{suffix}"] = groups[group]
            out[f"joint_torque_rms_by_joint{suffix}"] = _parts_of(parts, "joint_torque")
        out[f"{PRESSURE}_rms"] = self.rms.get(PRESSURE)
        return out | {WHITENED: self.rms.get(WHITENED), f"{WHITENED}_relative": self.relative.get(WHITENED)}


def _parts_of(parts: Mapping[str, float | None], group: str) -> dict[str, float | None]:
    """Those of a group by the name of the joint or axis."""
    return {name.removeprefix(f"{group}."): x for name, x in parts.items() if name.startswith(f"{group}.")}


class Evaluation:
    """Evaluate several parameter vectors in one pass over logs."""

    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        device: str = "cpu",
        terms: ExtraTerms | None = None,
        noise: SensorNoise | None = None,
    ) -> None:
        """Set robot, contacts and actuator terms. All recorded sensors of a log are used.

        `noise`: standard deviations of the recorded readings, NaN where unknown; errors are compared with them.
        """
        actuators = replace(terms or ExtraTerms(), offsets={}, scales={})
        self.robot = robot
        self.noise = noise
        sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
        self.builder = RowBuilder(robot, contacts, sensors, actuators).to(device)

    @property
    def least_carried(self) -> float:
        """Smallest force on the ground that gives a centre of pressure [N]."""
        return _CARRIES * GRAVITY * float(self.robot.nominal[:, MASS].sum())

    def metrics(self, logs: Sequence[Samples], phi: Array, progress: ProgressCallback | None = None) -> list[Metrics]:
        """One `Metrics` per row of `phi` (M, 12 L), over all samples, without the whitened projected residual."""
        measured, *errors = self.force_sums(logs, {log.fold: phi for log in logs} or {0: phi}, progress)
        return [self.summarize(measured, error) for error in errors]

    def force_sums(
        self, logs: Sequence[Samples], phi: Mapping[int, Array], progress: ProgressCallback | None = None
    ) -> list[ForceSums]:
        """Sums of squares of the measured forces, and of the errors of each row of `phi` (M, 12 L) by fold."""
        columns = {fold: self.builder.to_columns(values) for fold, values in phi.items()}
        count = 1 + len(next(iter(phi.values())))

        def sum_chunks(chunks: Iterator[tuple[Samples, ContactState]]) -> list[ForceSums]:
            sums = [ForceSums(self.robot.n_rows) for _ in range(count)]
            workspace = self.builder.workspaces.take()
            for samples, state in chunks:
                self._add(sums, self.builder.dynamics(samples, workspace, whole=True), state, columns)
            self.builder.workspaces.give_back(workspace)
            return sums

        loaded = [replace(log, unloaded=None) for log in logs]
        parts = map_chunks(loaded, self.builder, sum_chunks, progress=progress)
        return [ForceSums.total(same) for same in zip(*parts, strict=True)]

    def _add(self, sums: Sequence[ForceSums], chunk: Chunk, state: ContactState, phi: Mapping[int, Tensor]) -> None:
        """Add a chunk to the sums of the measured forces and of the errors."""
        builder = self.builder
        base = self.robot.base_rows
        joints = slice(base, base + self.robot.n)
        torque = _joint_forces(builder, chunk)
        measured = torque + _contact_forces(builder, chunk, state)
        predicted = _predicted_by_fold(builder, chunk, phi)
        sums[0].add_contact_forces(measured[:, joints], torque[:, joints])
        errors = torch.cat([-measured[None], predicted - measured])
        errors = builder.motors.of(builder.tree, chunk.states, chunk.without_rest(errors, base))
        for total, error in zip(sums, errors, strict=True):
            total.forces.add(error)
        if base:
            wrench = torch.cat([measured[None], predicted])[..., :base]
            points = _pressure_centres(builder, chunk, state, wrench, self.least_carried)
            for total, distance in zip(sums[1:], torch.linalg.vector_norm(points[1:] - points[0], dim=-1), strict=True):
                total.forces.add(distance, PRESSURE)
        for inside in null_space_components(builder, state, chunk, torch.cat([torque[None], predicted - torque])):
            for total, part in zip(sums, inside, strict=True):
                total.forces.add(part, "nullspace")
        if self.noise is not None:  # of some samples: it hardly changes
            thinned = chunk.select(slice(None, None, -(-len(chunk) // _NOISE_SAMPLES)))
            variance = reading_variance(builder, thinned, state, self.noise)
            sums[0].noise.add(variance.sqrt(), weight=len(chunk) / len(thinned))

    def summarize(self, measured: ForceSums, errors: ForceSums) -> Metrics:
        """Metrics from sums of squares."""
        places = _group_places(self.robot)
        rms = _all_rms(errors.forces, places)
        size = _all_rms(measured.forces, places)
        noise = _all_rms(measured.noise, places)
        parts = [name for name in places if "." in name]
        groups = [*ROW_GROUPS, *(group for group in LIMB_GROUPS if group in places)]
        if np.isfinite(rms[WHITENED]):
            groups.insert(len(ROW_GROUPS), WHITENED)
        pressure = finite_or_none(rms[PRESSURE])
        variation = measured.forces.deviation(places["base_force"])
        with_noise = ("joint_torque", "base_force", "base_moment", WHITENED)
        return Metrics(
            rms={group: finite_or_none(rms[group]) for group in groups} | ({PRESSURE: pressure} if pressure else {}),
            relative={group: _ratio(rms[group], size[group]) for group in groups},
            part_rms={part: finite_or_none(rms[part]) for part in parts},
            part_relative={part: _ratio(rms[part], size[part]) for part in parts},
            base_force_of_variation=_ratio(rms["base_force"], variation),
            noise={} if self.noise is None else {group: finite_or_none(noise[group]) for group in with_noise},
            limbs_in_air=bool(measured.contact_forces[0] and not measured.contact_forces[1]),
        )


# ------------------------------------------------------------------------------------- beside the nominal parameters


def compare_parts(nominal: Metrics, identified: Metrics) -> tuple[int, int, list[str]]:
    """Count joints and base axes that are predicted better; return (better, all, names of clearly worse ones)."""
    better = 0
    known = 0
    worse = []
    for part, before in nominal.part_rms.items():
        group, _, name = part.partition(".")
        after = identified.part_rms.get(part)
        if group in LIMB_GROUPS or before is None or after is None:
            continue
        known += 1
        better += after < before
        if before and _is_worse(before, after, identified.part_relative.get(part)):
            named = name if group == "joint_torque" else f"{group_name(group)} {name}"
            worse.append(f"{named} ({after / before:.2g} times)")
    return better, known, worse


def _is_worse(before: float, after: float, share: float | None) -> bool:
    """Whether an error is clearly larger than before; `share`: the error after, divided by the measured rms."""
    return after > _CLEARLY * before and after - before > _MATTERS * (after / share if share else 0.0)


def worse_than_nominal(sets: Mapping[str, tuple[Metrics, Metrics]]) -> list[WorseThanNominal]:
    """Groups of rows with clearly larger errors after the fit; `sets`: nominal and identified metrics by logs."""
    worse = []
    for logs, (nominal, identified) in sets.items():
        for group in DECISIVE_GROUPS:
            before = nominal.rms_of(group)
            after = identified.rms_of(group)
            if before is None or after is None:
                continue
            if _is_worse(before, after, identified.relative_of(group)):
                worse.append(WorseThanNominal(logs, group, before, after))
    return worse


@dataclass(frozen=True)
class WorseThanNominal:
    """A group of rows on a set of logs that the nominal parameters predict better, with both errors."""

    logs: str
    group: str
    nominal: float
    identified: float

    def __str__(self) -> str:
        return _describe_error(self.group, self.nominal, self.identified)


def describe_worse(groups: list[WorseThanNominal], nominal_label: str) -> str | None:
    """One line that lists such groups, None without any; `nominal_label`: "URDF" or "MJCF"."""
    if not groups:
        return None
    by_logs = {group.logs: [str(other) for other in groups if other.logs == group.logs] for group in groups}
    texts_by_logs = "; ".join(f"on {logs}: {join_names(texts)}" for logs, texts in by_logs.items())
    return f"WORSE THAN {nominal_label} ({nominal_label} -> identified) {texts_by_logs}"


def describe_errors(nominal: Metrics, identified: Metrics) -> str:
    """Nominal -> identified errors of all decisive groups that both have."""
    pairs = [(group, nominal.rms_of(group), identified.rms_of(group)) for group in DECISIVE_GROUPS]
    return "; ".join(_describe_error(x, a, b) for x, a, b in pairs if a is not None and b is not None)


def _describe_error(group: str, nominal: float, identified: float) -> str:
    unit = _LABELS[group].split("[")[1].rstrip("]")
    return f"{group_name(group)} {nominal:.3g} -> {identified:.3g} {unit}"


def group_name(group: str) -> str:
    """Name of a group of rows, without its unit."""
    return _LABELS[group].split(" [")[0]


def finite_or_none(x: float) -> float | None:
    """A number, or None where there is none."""
    return float(x) if np.isfinite(x) else None


def _ratio(x: float, y: float) -> float | None:
    return float(x / y) if np.isfinite(x) and y > 0.0 else None
