"""Measured and predicted generalized forces, sample by sample, and readings corrected by offsets and scales."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.logs.lazy_arrays import Spill
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem.chunk_dynamics import ChunkDynamics, ChunkKinematics, folds_in
from torchid.problem.chunks import chunks_by_state
from torchid.problem.contact_state import ContactState
from torchid.problem.extras import ACTUATORS, Extra, contact_extra_column, dof_extra_column
from torchid.problem.rows import RowBuilder, leave_out_torques
from torchid.problem.samples import Samples
from torchid.regressor.columns import body_wrenches
from torchid.regressor.regressor import friction_columns, generalized_forces, joint_row
from torchid.regressor.tree import KinematicTree
from torchid.sensing import SensorNoise

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


def predict_forces(builder: RowBuilder, kinematics: ChunkKinematics, phi: Tensor) -> Tensor:
    """K phi, (M, n_rows, B), for M parameter vectors (M, columns) in the builder's columns, without extras.

    Joint forces are products of screw axes with wrenches summed over subtrees; the rows of K are never formed.
    """
    tree, columns = builder.tree, builder.columns
    wrench = body_wrenches(kinematics.states, columns.inertial_by_node(phi))
    below = tree.ancestors.T @ wrench
    torque = below.mul_(kinematics.screw_axes[:, None]).sum(0)
    coulomb, viscous = phi[:, columns.layout.count : columns.count, None].unflatten(1, (-1, 2)).unbind(2)
    joints = kinematics.joints
    torque[:, 1:].addcmul_(coulomb, joints.direction[1:]).addcmul_(viscous, joints.velocity[1:])
    by_joint = tree.joint_map.T @ torque
    return torch.cat([wrench.sum(2).transpose(0, 1), by_joint], 1) if tree.base_rows else by_joint


def predict_by_columns(builder: RowBuilder, dynamics: ChunkDynamics, phi: Tensor) -> Tensor:
    """As `predict_forces`, of some hundred parameter vectors: by columns of K, which all of these have in common."""
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
    builder: RowBuilder, samples: Samples, state: ContactState, phi: Mapping[int, Tensor], kinematics: ChunkKinematics
) -> GeneralizedForces:
    """Measured and predicted forces of samples that share a contact state; `phi` is (M, width) by fold.

    Sensors are taken as calibrated: of the extras only those of actuators enter. A payload adds to each `phi`, known
    armatures and springs to each prediction.
    """
    base_rows = builder.tree.base_rows
    torque = torch.nn.functional.pad(builder.recorded_torque(samples), (base_rows, 0))
    measured = torque + contact_forces(builder, samples, state, kinematics).T
    by_fold = [
        _predicted(builder, samples[start:end], kinematics.some(slice(start, end)), phi[fold])
        for fold, start, end in folds_in(samples)
    ]
    predicted = by_fold[0] if len(by_fold) == 1 else torch.cat(by_fold, dim=1)
    return GeneralizedForces(measured, torque, predicted)


def _predicted(builder: RowBuilder, samples: Samples, kinematics: ChunkKinematics, phi: Tensor) -> Tensor:
    """What `measured_and_predicted_forces` predicts at parameters (M, width), (M, B, n_rows)."""
    predicted = predict_forces(builder, kinematics, with_payload_columns(builder, samples, phi)).mT
    base_rows = builder.tree.base_rows
    if not builder.known_torques.none:
        predicted[..., base_rows:] += builder.known_torques.of(samples)
    for number, extra in enumerate(builder.extras, start=builder.columns.count):
        for dof in extra.dofs if extra.what in ACTUATORS else ():
            column = dof_extra_column(extra, dof, samples, builder.tree)
            predicted[..., base_rows + dof] += phi[:, number, None] * column
    return predicted


def noise_series(builder: RowBuilder, samples: Samples, noise: SensorNoise) -> Array:
    """Standard deviation of the measured forces of a log in its order by `reading_variance`, (N, n_rows) [N, N m]."""
    out = np.empty((len(samples), builder.tree.n_rows))
    with torch.no_grad(), one_thread():
        for state, index in chunks_by_state(samples):
            chunk = samples[index].to(builder.device)
            variance = reading_variance(builder, chunk, state, builder.kinematics(chunk), noise)
            out[index if isinstance(index, slice) else index.numpy()] = variance.sqrt().cpu().numpy()
    return out


def force_series(builder: RowBuilder, samples: Samples, phi: Array) -> tuple[Array, Array]:
    """Measured (N, n_rows) and predicted (M, N, n_rows) forces of a log in its order, `phi` as for `to_columns`."""
    columns = builder.to_columns(phi)
    n_rows = builder.tree.n_rows
    measured, predicted = np.empty((len(samples), n_rows)), np.empty((len(phi), len(samples), n_rows))
    with torch.no_grad(), one_thread():
        for state, index in chunks_by_state(samples):
            chunk = samples[index].to(builder.device)
            by_fold, kinematics = {chunk.fold: columns}, builder.kinematics(chunk)
            forces = measured_and_predicted_forces(builder, chunk, state, by_fold, kinematics)
            where = index if isinstance(index, slice) else index.numpy()
            measured[where] = forces.measured.cpu().numpy()
            predicted[:, where] = forces.predicted.cpu().numpy()
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


def pressure_series(builder: RowBuilder, samples: Samples, wrenches: Array, least: float) -> Array:
    """`pressure_centres` of wrenches (M, N, 6) of a log in its order, (M, N, 3) [m]."""
    out = np.empty((*wrenches.shape[:2], 3))
    with torch.no_grad(), one_thread():
        for state, index in chunks_by_state(samples):
            chunk, where = samples[index].to(builder.device), index if isinstance(index, slice) else index.numpy()
            wrench, kinematics = torch.from_numpy(wrenches[:, where]).to(chunk.time), builder.kinematics(chunk)
            out[:, where] = pressure_centres(builder, chunk, state, kinematics, wrench, least).cpu().numpy()
    return out


def null_space_part(builder: RowBuilder, samples: Samples, forces: Array) -> Array:
    """V_x V_x^T f of generalized forces (M, N, n_rows): the part of each row inside the builder's null space."""
    out, base = forces.copy(), builder.tree.base_rows
    with torch.no_grad(), one_thread():
        for state, index in chunks_by_state(samples):
            where = np.arange(len(samples))[index if isinstance(index, slice) else index.numpy()]
            coupled = [*range(base), *(base + joint for joint in builder.layout(state).coupled_joints)]
            kinematics = builder.kinematics(samples[index].to(builder.device))
            for part, V in builder.null_space_bases(state, kinematics):
                chosen = where[part if isinstance(part, slice) else part.cpu().numpy()]
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


def at_motors(builder: RowBuilder, samples: Samples, forces: Array) -> Array:
    """Generalized forces of a log in its order, (M, N, n_rows), as the motors of closed loops feel them."""
    if builder.motors.none:
        return forces
    out = forces.copy()
    with torch.no_grad(), one_thread():
        for _, index in chunks_by_state(samples):
            kinematics = builder.kinematics(samples[index].to(builder.device))
            where = index if isinstance(index, slice) else index.numpy()
            part = torch.from_numpy(forces[:, where]).to(kinematics.screw_axes)
            out[:, where] = builder.motors.of(builder.tree, kinematics, part).cpu().numpy()
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


def projected_forces(builder: RowBuilder, samples: Samples, phi: torch.Tensor) -> ProjectedForces:
    """The rows of a fit, W^T [K phi, f], mapped back by W (W^T W)^-1, whose span is that of V_x.

    Args:
        builder: of the rows.
        samples: of one log.
        phi: (M, width), parameters in the builder's columns, extra ones included.
    """
    shape = len(samples), builder.tree.n_rows
    measured, noise, predicted = np.empty(shape), np.empty(shape), np.empty((len(phi), *shape))
    with torch.no_grad(), one_thread():
        for state, index in chunks_by_state(samples, _CHUNK):
            chunk = samples[index].to(builder.device)
            rows, W = builder.rows_by_sample(chunk, state)
            gram = W.mT @ W
            gram.diagonal(dim1=1, dim2=2)[(W == 0.0).all(1)] = 1.0  # of samples with fewer rows
            back = torch.linalg.solve(gram, W.mT).mT
            forces = back @ torch.cat([rows[..., -1:], rows[..., :-1] @ phi.T], dim=2)
            forces[(W == 0.0).all(2)] = torch.nan
            where = index if isinstance(index, slice) else index.numpy()
            measured[where] = forces[..., 0].cpu().numpy()
            predicted[:, where] = forces[..., 1:].permute(2, 0, 1).cpu().numpy()
            noise[where] = (back.square().sum(2) * chunk.noise_left).sqrt().cpu().numpy()
            if builder.task_weights is not None:
                noise[where] = np.nan  # rows are white in other units
    return ProjectedForces(measured, predicted, noise)
