"""The linear problem of all motions that contact states allow: an upper bound of what sensors determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchid.errors import UrdfError
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples, compress, linear_problem
from torchid.problem.base_motion import BaseMotion
from torchid.problem.contact_state import ContactState
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
from torchid.robot.constraints import LOOPS_FIELD
from torchid.rounding import KINEMATIC_TOLERANCE
from torchid.sensing import Contact, SensorSet

_ANGLE, _STROKE = 1.5, 0.3  # largest joint position [rad], [m]
_ASSEMBLY = 0.3  # of random postures: from there the loops are closed for the first time
_PATH = 10  # steps from one posture to another
_REGULAR = 0.1  # of the least singular value of a loop Jacobian where it is largest, what must be left of it elsewhere
_LEAST_SHARE = 0.01  # of the way to a random posture, to which a path is cut short
_SAMPLES_PER_COLUMN = 2  # per state: a sample gives at least one row, and some directions are rarely excited
_WEIGHTLESS = (0.0, 0.0, 0.0)
_SOLE_STEPS, _SOLE_STEP = 30, 1.0  # that turn soles along the ground, and the longest of them [rad]
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
    """The linear problem of random motions in some contact states; its right-hand side is 0.

    Its rank is an upper bound of that of any log.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        sensors: which forces are measured.
        states: contact states the robot may be in.
        friction: whether friction is free.
        samples: of these states, if they have been drawn already.
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

    The ground differs between samples: points and lines stand on any slope, flat feet of a floating base stand along
    their contacts' normals, so that gravity never turns in their frames on a level floor. The rank is an upper bound of
    that on one ground. A fixed base stands as the robot's.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        state: which of them touch the ground.
        count: number N of samples.
        rng: draws them.
    """
    q, v, a = standing_states(robot, contacts, state, count, rng)
    rows, base = robot.base_rows, BaseMotion.from_coordinates(q, v, a, robot.fixed_base)
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
    """Coordinates q (B, n + 7), v, a (B, nv), as `Regressor` takes them: `J_C v = 0`, `J_C a + dJ_C/dt v = 0`.

    J_C has the rows of the components that active contacts can exert: a point contact fixes its frame's origin, a flat
    one the whole frame, a line contact all but the rotation about itself; with a radius, they roll. Twice as many
    states are drawn, and those nearest to a singular J_C are dropped: accelerations are unbounded there. Loops are
    closed, and have rows too. Of flat feet the frames' axes that are nearest to upward at joint positions of 0 are
    along the normals, but for robots with loops.

    Raises:
        UrdfError: loops that close nowhere.
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
    q, v, a, J = q[best], v[best], a[best], J[best]
    inverse = torch.linalg.pinv(J, rtol=KINEMATIC_TOLERANCE)
    v = _in_null_space(v, inverse, J)
    v = torch.where(v.abs() < _AT_REST, 0.0, v)
    drift = _drift(robot, constrained, q, v)
    return q, v, _in_null_space(a, inverse, J) - (inverse @ drift[..., None])[..., 0]


def resting_samples(joint_position: Array, state: ContactState) -> Samples:
    """Samples of an upright robot at rest, at joint positions (N, n) [rad or m] in a contact state, without forces."""
    q = torch.from_numpy(np.ascontiguousarray(joint_position, dtype=float))
    still, base = torch.zeros_like(q), q.new_zeros(len(q), 3)
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
    closures, steps = LoopClosures(robot), torch.from_numpy(postures) / _PATH
    zero = torch.zeros(1, robot.n, dtype=torch.float64)
    found, closed = closures.closed(torch.cat([zero, _ASSEMBLY * torch.from_numpy(postures)]))
    if not closed.any():
        size = float(closures.deviations(zero).abs().max())
        text = f"loops that are open by {size:.3g} m or rad at joint positions of 0, and close nowhere near"
        raise UrdfError(robot.path, LOOPS_FIELD, text, "frames that the joints can bring together")
    found = found[closed]
    found = found[found.abs().amax(1).argsort()]
    values = torch.linalg.svdvals(closures.jacobian(found))
    rank = int((values > KINEMATIC_TOLERANCE * values[:, :1]).sum(1).max())
    least = _REGULAR * float(values[:, rank - 1].max())
    assembled = found[values[:, rank - 1] > least][:1]
    out, left, share = assembled.repeat(len(postures), 1), torch.arange(len(postures)), 1.0
    while len(left) and share > _LEAST_SHARE:
        q, kept = assembled.repeat(len(left), 1), torch.ones(len(left), dtype=torch.bool)
        for _ in range(_PATH):
            q, closed = closures.closed(q + share * steps[left])
            kept &= closed & (torch.linalg.svdvals(closures.jacobian(q))[:, rank - 1] > least)
        out[left[kept]] = q[kept]
        left, share = left[~kept], share / 2.0
    return np.asarray(out.numpy())


def _stand_on_soles(robot: Robot, soles: Sequence[Contact], q: Tensor) -> Tensor:
    """Coordinates (B', n + 7) near others (B, n + 7) at which flat feet stand along their contacts' normals.

    Newton's steps on the base's orientation and the joints; of postures from which they do not lead there none is left.
    """
    jacobians = [FrameJacobian(robot, contact.frame) for contact in soles]
    rest = q.new_tensor([0.0] * 6 + [1.0] + [0.0] * robot.n)[None]
    upward = [J(rest)[0, :3, 2] for J in jacobians]  # of the base's z axis in the frames
    axes = [torch.where(up.abs() == up.abs().max(), up.sign(), 0.0) for up in upward]
    for _ in range(_SOLE_STEPS):
        rows, wanted = [], []
        for contact, jacobian, axis in zip(soles, jacobians, axes, strict=True):
            J, normal = jacobian(q), q.new_tensor(contact.normal)
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
    v, a = rng.normal(size=(count, robot.nv)), 3.0 * rng.normal(size=(count, robot.nv))
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
        own = frame_acceleration(states, node, pose, arms)
        rows.append(along_frame(states, node, pose, own)[list(contact.components)])
    if robot.loops:
        joints = (x[:, x.shape[1] - robot.n :] for x in (q, v))
        rows.append(LoopClosures(robot).drift(*joints).T)
    return torch.cat(rows).T
