"""Measured and predicted generalized forces, and errors of these by group of rows, also beside the nominal model's."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.errors import format_percent, join_names
from torchid.logs.lazy_arrays import Spill
from torchid.parallel import one_thread
from torchid.parameters import GRAVITY, MASS, Array
from torchid.problem.chunks import CHUNK, ProgressCallback, blocks_in, chunks_by_state, map_chunks
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import ACTUATORS, Extra, ExtraTerms, contact_extra_column, dof_extra_column
from torchid.problem.rows import ChunkDynamics, ChunkKinematics, RowBuilder, leave_out_torques
from torchid.problem.samples import Samples
from torchid.regressor.regressor import friction_columns, generalized_forces, joint_row
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, named_sensors

_ROWS = 2**16  # of a log on disk that are in memory at a time


def calibrate_readings(samples: Samples, extras: Sequence[Extra], values: Array, tree: KinematicTree) -> Samples:
    """Samples with calibrated readings, s y - o for an offset o and a scale s of the reading y.

    Readings without extra parameters are shared with `samples`; the others are on disk if `samples` are.

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
        for dof in extra.dofs:
            copies[name][:, dof] -= value * dof_extra_column(extra, dof, samples, tree)
        for contact, axis in extra.contacts:
            copies[name][:, contact, axis] -= value * contact_extra_column(extra, samples, contact, axis)
    return copies


@dataclass(frozen=True)
class GeneralizedForces:
    """Generalized forces of some samples, rows as in K: base force, base moment, joints.

    `measured`, (B, n_rows): S^T tau + J_C^T lambda [N, N m], NaN where a force that enters was not measured. `torque`,
    (B, n_rows): the part S^T tau. `predicted`, (M, B, n_rows): K phi for M parameter vectors.
    """

    measured: Tensor
    torque: Tensor
    predicted: Tensor


def predict_forces(builder: RowBuilder, dynamics: ChunkDynamics, phi: Tensor) -> Tensor:
    """K phi, (M, n_rows, B), for M parameter vectors (M, columns) in the builder's columns, without extras.

    Row by row: no more of K than one of its rows is ever formed. `dynamics`: whole ones.
    """
    tree, columns = builder.tree, builder.columns
    inertial, base = columns.layout.count, tree.base_rows
    out = phi.new_empty(tree.n_rows, len(phi), dynamics.wrenches.shape[-1])
    torch.matmul(phi[:, :inertial], dynamics.wrenches[:base], out=out[:base])
    for row, forces in zip(columns.joint_rows, out[base:], strict=True):
        block = joint_row(row, tree, columns.layout, dynamics.screw_axes, dynamics.wrenches)
        torch.mm(phi[:, row.start : row.end], block, out=forces)
        for body, *friction in friction_columns(row, dynamics.joints):
            at = columns.friction(body)
            forces.addmm_(phi[:, at : at + 2], torch.stack(friction))
    return out.transpose(0, 1)


def with_payload_columns(builder: RowBuilder, samples: Samples, phi: Tensor) -> Tensor:
    """Parameters (M, columns) in the builder's columns of a robot with the payload of some samples."""
    return phi if samples.payload is None else phi + builder.to_columns(samples.payload[None]).to(phi)


def contact_forces(builder: RowBuilder, samples: Samples, state: ContactState, kinematics: ChunkKinematics) -> Tensor:
    """J_C^T lambda, (n_rows, B), over the active contacts; NaN in the rows that an unmeasured component reaches."""
    tree = builder.tree
    total = samples.time.new_zeros(tree.n_rows, len(samples))
    for contact, active in enumerate(state):
        if active:
            body, _ = builder.frames[contact]
            possible = list(builder.contacts[contact].components)
            components = builder.recorded_wrench(samples, contact, kinematics)[:, possible].T
            at_base = builder.unit_wrenches(kinematics, contact, possible)
            wrench = (at_base * components).sum(1, keepdim=True)
            joints = builder.columns.joints_above(body)  # other rows must not become NaN by an unmeasured force
            rows = builder.columns.rows_above(body)
            total[rows] += generalized_forces(tree, kinematics.screw_axes, body, wrench, joints)[0]
    return total


def reading_variance(
    builder: RowBuilder, samples: Samples, state: ContactState, kinematics: ChunkKinematics, noise: SensorNoise
) -> Tensor:
    """Variance of S^T tau + J_C^T lambda by the noise of the readings, (B, n_rows) [N^2, (N m)^2].

    A filter leaves a share of it, `noise_left` of the samples. NaN where a reading that enters, or its
    noise, is not known.

    Args:
        builder: with all recorded sensors.
        samples: of one contact state.
        state: that state.
        kinematics: of the samples.
        noise: standard deviations of the readings as recorded, NaN where unknown.
    """
    tree = builder.tree
    total = samples.time.new_zeros(tree.n_rows, len(samples))
    std = noise.dof_std(tree.n, tree.n_dofs)
    std[list(builder.motors.passive)] = np.nan
    torque = builder.recorded_torque(samples).T
    total[tree.base_rows :] = total.new_tensor(std**2)[:, None] + 0.0 * torque  # NaN where it was not recorded
    for contact, active in enumerate(state):
        if active:
            body, _ = builder.frames[contact]
            possible = list(builder.contacts[contact].components)
            wrenches = builder.unit_wrenches(kinematics, contact, possible, noise.wrench_std)
            joints = builder.columns.joints_above(body)
            rows = builder.columns.rows_above(body)
            recorded = 0.0 * builder.recorded_wrench(samples, contact, kinematics)[:, possible].sum(1)
            forces = total.new_zeros(len(possible), *total.shape)
            forces[:, rows] = generalized_forces(tree, kinematics.screw_axes, body, wrenches, joints)
            total += builder.motors.of(tree, kinematics, forces.mT).mT.square().sum(0)
            total[rows] += recorded
    return total.T * samples.noise_left


def measured_and_predicted_forces(
    builder: RowBuilder, samples: Samples, state: ContactState, phi: Mapping[int, Tensor], dynamics: ChunkDynamics
) -> GeneralizedForces:
    """Measured and predicted forces of samples that share a contact state; `phi` is (M, width) by fold.

    Sensors are taken as calibrated: of the extras only those of actuators enter. A payload adds to each `phi`, known
    armatures and springs to each prediction.
    """
    base_rows = builder.tree.base_rows
    torque = torch.nn.functional.pad(builder.recorded_torque(samples), (base_rows, 0))
    measured = torque + contact_forces(builder, samples, state, dynamics).T
    by_fold = [
        _predicted(builder, samples[start:end], dynamics.select(slice(start, end)), phi[fold])
        for fold, _, start, end in blocks_in(samples)
    ]
    predicted = by_fold[0] if len(by_fold) == 1 else torch.cat(by_fold, dim=1)
    return GeneralizedForces(measured, torque, predicted)


def _predicted(builder: RowBuilder, samples: Samples, dynamics: ChunkDynamics, phi: Tensor) -> Tensor:
    """What `measured_and_predicted_forces` predicts at parameters (M, width), (M, B, n_rows)."""
    predicted = predict_forces(builder, dynamics, with_payload_columns(builder, samples, phi)).mT
    base_rows = builder.tree.base_rows
    if not builder.known_torques.none:
        predicted[..., base_rows:] += builder.known_torques.of(samples)
    for number, extra in enumerate(builder.extras, start=builder.columns.count):
        for dof in extra.dofs if extra.what in ACTUATORS else ():
            column = dof_extra_column(extra, dof, samples, builder.tree)
            predicted[..., base_rows + dof] += phi[:, number, None] * column
    return predicted


def _on_device(
    builder: RowBuilder, samples: Samples, chunk: int = CHUNK
) -> Iterator[tuple[Samples, ContactState, slice | np.ndarray]]:
    """A log in chunks of one contact state on the builder's device, and where in its order these belong."""
    for state, index in chunks_by_state(samples, chunk):
        yield samples[index].to(builder.device), state, index if isinstance(index, slice) else index.numpy()


@one_thread()
@torch.no_grad()
def noise_series(builder: RowBuilder, samples: Samples, noise: SensorNoise) -> Array:
    """Standard deviation of the measured forces of a log in its order by `reading_variance`, (N, n_rows) [N, N m]."""
    out = np.empty((len(samples), builder.tree.n_rows))
    for chunk, state, where in _on_device(builder, samples):
        variance = reading_variance(builder, chunk, state, builder.kinematics(chunk), noise)
        out[where] = variance.sqrt().cpu().numpy()
    return out


@one_thread()
@torch.no_grad()
def force_series(builder: RowBuilder, samples: Samples, phi: Array) -> tuple[Array, Array]:
    """Measured (N, n_rows) and predicted (M, N, n_rows) forces of a log in its order, `phi` as for `to_columns`."""
    columns, workspace = builder.to_columns(phi), builder.workspaces.take()
    n_rows = builder.tree.n_rows
    measured, predicted = np.empty((len(samples), n_rows)), np.empty((len(phi), len(samples), n_rows))
    for chunk, state, where in _on_device(builder, samples):
        dynamics = builder.dynamics(chunk, workspace, whole=True)
        forces = measured_and_predicted_forces(builder, chunk, state, {chunk.fold: columns}, dynamics)
        measured[where] = forces.measured.cpu().numpy()
        predicted[:, where] = forces.predicted.cpu().numpy()
    builder.workspaces.give_back(workspace)
    return measured, predicted


def centre_of_pressure(wrench: Tensor, normal: Tensor, height: Tensor, least: float = 0.0) -> Tensor:
    """Where a wrench (..., B, 6) at the base origin meets the ground, (..., B, 3) [m] from that origin.

    The ground's normal n, (B, 3), is in base axes, the base's height above it h, (B,). About the point p the moment is
    along n: p = (n x M - h F) / (n F). Undefined, NaN, where the force along n is at most `least` [N].

    Source: Sardain, Bessonnet, "Forces acting on a biped robot. Center of pressure - zero moment point", 2004.
    """
    force, moment = wrench[..., :3], wrench[..., 3:]
    across = torch.linalg.cross(normal.expand_as(moment), moment)
    carried = (force * normal).sum(-1, keepdim=True)
    return (across - height[:, None] * force) / carried.where(carried > least, torch.nan)


def pressure_centres(
    builder: RowBuilder, samples: Samples, state: ContactState, at: ChunkKinematics, wrench: Tensor, least: float
) -> Tensor:
    """`centre_of_pressure` of wrenches (M, B, 6) on the mean plane of active contacts; NaN without any, or attitude."""
    active, rotation = [k for k, touches in enumerate(state) if touches], at.rotation_world_base
    if rotation is None or not active:
        return torch.full_like(wrench[..., :3], torch.nan)
    contacts, states = [builder.contacts[k] for k in active], at.states
    normals = wrench.new_tensor([contact.normal for contact in contacts])
    normals = (normals if samples.contact_normal is None else samples.contact_normal[:, active]) @ rotation
    radii = wrench.new_tensor([contact.radius for contact in contacts])
    frames = [(node, wrench.new_tensor(T[:3, 3])) for node, T in (builder.frames[k] for k in active)]
    points = [states.position[:, node] + point @ states.rotation[:, :, node] for node, point in frames]
    soles = torch.stack(points).permute(2, 0, 1) - radii[:, None] * normals
    normal = torch.nn.functional.normalize(normals.mean(1), dim=1)
    return centre_of_pressure(wrench, normal, -(soles @ normal[..., None]).mean((1, 2)), least)


@one_thread()
@torch.no_grad()
def pressure_series(builder: RowBuilder, samples: Samples, wrenches: Array, least: float) -> Array:
    """`pressure_centres` of wrenches (M, N, 6) of a log in its order, (M, N, 3) [m]."""
    out = np.empty((*wrenches.shape[:2], 3))
    for chunk, state, where in _on_device(builder, samples):
        wrench, kinematics = torch.from_numpy(wrenches[:, where]).to(chunk.time), builder.kinematics(chunk)
        out[:, where] = pressure_centres(builder, chunk, state, kinematics, wrench, least).cpu().numpy()
    return out


@one_thread()
@torch.no_grad()
def null_space_part(builder: RowBuilder, samples: Samples, forces: Array) -> Array:
    """V_x V_x^T f of generalized forces (M, N, n_rows): the part of each row inside the builder's null space."""
    out, base, every = forces.copy(), builder.tree.base_rows, np.arange(len(samples))
    for chunk, state, where in _on_device(builder, samples):
        coupled = [*range(base), *(base + joint for joint in builder.layout(state).coupled_joints)]
        for part, V in builder.null_space_bases(state, builder.kinematics(chunk)):
            chosen = every[where][part if isinstance(part, slice) else part.cpu().numpy()]
            at = np.ix_(np.arange(len(forces)), chosen, coupled)
            inside = V @ (V.mT @ torch.from_numpy(forces[at]).to(V)[..., None])
            out[at] = inside[..., 0].cpu().numpy()
    return out


def null_space_components(
    builder: RowBuilder, state: ContactState, kinematics: ChunkKinematics, vectors: Tensor
) -> Iterator[Tensor]:
    """V_x^T of generalized forces (M, B, n_rows), V_x the contacts' null space, in groups of one rank, (M, B', r).

    Joints away from contacts pass unchanged. NaN in place of what joints at rest leave unknown.
    """
    layout, base = builder.layout(state), builder.tree.base_rows
    coupled = [*range(base), *(base + joint for joint in layout.coupled_joints)]
    uncoupled = [base + joint for joint in layout.uncoupled_joints]
    resting = builder.coupled_at_rest(layout, kinematics)
    alone = kinematics.without_rest(vectors, base)[..., uncoupled]
    vectors = kinematics.without_rest(vectors, base, 0.0)
    for index, V in builder.null_space_bases(state, kinematics):
        if resting is not None:
            V = V.clone()
            leave_out_torques(V.permute(1, 2, 0), resting[:, index])
        # contiguous, as products of other layouts take ten times as long
        by_sample = vectors[:, index].permute(1, 2, 0)[:, coupled].contiguous()
        inside = (V.mT.contiguous() @ by_sample).permute(2, 0, 1)
        if resting is not None:
            inside = inside.masked_fill(~V.any(1), torch.nan)
        yield torch.cat([inside, alone[:, index]], dim=2)


@one_thread()
@torch.no_grad()
def at_motors(builder: RowBuilder, samples: Samples, forces: Array) -> Array:
    """Generalized forces of a log in its order, (M, N, n_rows), as the motors of closed loops feel them."""
    if builder.motors.none:
        return forces
    out = forces.copy()
    for chunk, _, where in _on_device(builder, samples):
        part = torch.from_numpy(forces[:, where]).to(chunk.time)
        out[:, where] = builder.motors.of(builder.tree, builder.kinematics(chunk), part).cpu().numpy()
    return out


_CHUNK = 512  # samples: rows are dense here


@dataclass(frozen=True)
class ProjectedForces:
    """Generalized forces V_x V_x^T f of a log, rows as in K, with what a fit predicts of them [N, N m].

    `measured`, (N, n_rows), as recorded: predictions have offsets and scales. `predicted`, (M, N, n_rows). `noise`,
    (N, n_rows): standard deviation that the noise of the readings gives the measured. NaN where readings lack, in rows
    that no reading is of, and of all noise under task weights.
    """

    measured: Array
    predicted: Array
    noise: Array


@one_thread()
@torch.no_grad()
def projected_forces(builder: RowBuilder, samples: Samples, phi: torch.Tensor) -> ProjectedForces:
    """The rows of a fit, W^T [K phi, f], mapped back by W (W^T W)^-1, whose span is that of V_x.

    Args:
        builder: of the rows.
        samples: of one log.
        phi: (M, width), parameters in the builder's columns, extra ones included.
    """
    shape = len(samples), builder.tree.n_rows
    measured, noise, predicted = np.empty(shape), np.empty(shape), np.empty((len(phi), *shape))
    for chunk, state, where in _on_device(builder, samples, _CHUNK):
        rows, W = builder.rows_by_sample(chunk, state)
        gram = W.mT @ W
        gram.diagonal(dim1=1, dim2=2)[(W == 0.0).all(1)] = 1.0  # of samples with fewer rows
        back = torch.linalg.solve(gram, W.mT).mT
        forces = back @ torch.cat([rows[..., -1:], rows[..., :-1] @ phi.T], dim=2)
        forces[(W == 0.0).all(2)] = torch.nan
        measured[where] = forces[..., 0].cpu().numpy()
        predicted[:, where] = forces[..., 1:].permute(2, 0, 1).cpu().numpy()
        noise[where] = (back.square().sum(2) * chunk.noise_left).sqrt().cpu().numpy()
        if builder.task_weights is not None:
            noise[where] = np.nan  # rows are white in other units
    return ProjectedForces(measured, predicted, noise)


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
            workspace = builder.workspaces.take()
            for samples, state in chunks:
                kinematics = builder.dynamics(samples, workspace, whole=True)
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
            builder.workspaces.give_back(workspace)
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
        variance = reading_variance(self.builder, part, state, kinematics.select(slice(None, None, step)), noise)
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
