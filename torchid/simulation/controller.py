"""What the robot is to do, how it stands, and the task-space inverse dynamics that follow."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from torchid.config import MotionConfig, StepsConfig
from torchid.errors import InputError, UnknownNameError
from torchid.logs.log import BoolArray
from torchid.parameters import Array
from torchid.simulation.plant import Foot, FootMotion, Plant, rotation_error

_STIFFNESS, _DAMPING = 100.0, 20.0  # 1/s^2, 1/s: errors decay within half a second, without overshoot
_CREEP, _FOOT_DAMPING = 100.0, 20.0  # 1/s^2, 1/s, of a foot that stands: friction holds it, but lets it creep
_CONSTRAINED, _STANDING, _CENTRE, _TURN, _SWING, _JOINT, _POSTURE = (
    1000.0,
    100.0,
    10.0,
    10.0,
    10.0,
    3.0,
    0.05,
)  # weights
ALOFT = 1e-3  # a foot that carries a smaller share than this is off the floor
_PREVIEW, _SMOOTH = 0.02, 0.05  # s, rad/s: friction is that of the velocity to come, and smooth where it turns
_TRIES, _LEAST_POINTS = 3, 3
_ITERATIONS, _LARGEST_STEP = 300, 0.2
_SINGULAR = 1e-4  # share of the largest singular value
_TOLERANCE = 1e-3  # m or rad
_STEEPEST = np.radians(40.0)  # that a sole may be off the horizontal in the given posture


@dataclass(frozen=True)
class Stance:
    """A standing robot: configuration (7 + n,) and centre of mass (3,); feet's middles (F, 3), rotations (F, 3, 3)."""

    position: Array
    com: Array
    feet: Array
    rotations: Array


def find_stance(plant: Plant, feet: Sequence[Foot], posture: Mapping[str, float]) -> Stance:
    """Put the robot on its feet, its base level and its centre of mass over their middle, close to a posture.

    Args:
        plant: the robot; left in the stance.
        feet: what it stands on.
        posture: joint positions by name [rad or m]; others are 0, or the end of their range nearest to it.

    Raises:
        UnknownNameError: a joint that the robot does not have.
        InputError: a joint beyond its limits, or no such configuration near the posture.
    """
    for name in posture:
        if name not in plant.joint_names:
            raise UnknownNameError.at_field("posture", name, plant.joint_names)
    low, high = plant.limits.T
    for name, value in posture.items():
        joint = plant.joint_names.index(name)
        if not low[joint] <= value <= high[joint]:
            accepted = f"{low[joint]:g} to {high[joint]:g}, the joint's limits"
            raise InputError.at_field(f"posture.{name}", f"{value:g}", accepted)
    joints = np.clip([posture.get(name, 0.0) for name in plant.joint_names], low, high)
    plant.place(np.concatenate([np.zeros(3), [1.0, 0.0, 0.0, 0.0], joints]))
    rotations = np.stack([_flattened(plant.foot(i).rotation, foot) for i, foot in enumerate(feet)])
    targets = np.stack([plant.foot(i).position for i in range(len(feet))])
    for target, R, foot in zip(targets, rotations, feet, strict=True):
        target[2] = -np.min(foot.arms @ R[2] - foot.radii)
    lift = np.mean([target[2] - plant.foot(i).position[2] for i, target in enumerate(targets)])
    plant.place(plant.shift(lift * np.eye(plant.nv)[2]))

    for _ in range(_ITERATIONS):
        A, off = _tasks(plant, feet, targets, rotations)
        home = np.concatenate([np.zeros(6), joints - plant.position[7:]])
        step = home + np.linalg.pinv(A, rcond=_SINGULAR) @ (off - A @ home)  # the posture yields to everything else
        step *= min(1.0, _LARGEST_STEP / max(np.abs(step).max(), _LARGEST_STEP))
        moved = plant.shift(step)
        moved[7:] = np.clip(moved[7:], low, high)
        plant.place(moved)
        if np.abs(step).max() < 1e-9:
            break
    _, off = _tasks(plant, feet, targets, rotations)
    if not np.abs(off).max() < _TOLERANCE:
        worst = np.abs(off).max()
        found = f"no stance near it with all feet on the floor and the base level: off by {worst:.2g} m or rad"
        raise InputError.at_field("posture", found, "joint positions, by name, in which the robot nearly stands")
    return Stance(plant.position.copy(), plant.com.copy(), targets, rotations)


def _tasks(plant: Plant, feet: Sequence[Foot], targets: Array, rotations: Array) -> tuple[Array, Array]:
    """What should be zero: Jacobian (rows, nv), and how far off it is (rows,) [m, rad]."""
    jacobians, off = [], []
    for i, (foot, target, R) in enumerate(zip(feet, targets, rotations, strict=True)):
        now = plant.foot(i)
        jacobians.append(now.J[: foot.constrained])
        off.append(np.concatenate([target - now.position, rotation_error(now.rotation, R)])[: foot.constrained])
    level = np.zeros((3, plant.nv))
    level[:, 3:6] = np.eye(3)
    J_constraints, open_by, _ = plant.constraints
    A = np.vstack([*jacobians, J_constraints, plant.inertia[:2] / plant.mass, level])
    above = (targets.mean(axis=0) - plant.com)[:2]
    return A, np.concatenate([*off, -open_by, above, rotation_error(plant.base_rotation, np.eye(3))])


def _flattened(R: Array, foot: Foot) -> Array:
    """The rotation nearest to R that puts all points of the foot at one height."""
    if foot.constrained < 6:
        return R.copy()
    normal = np.linalg.svd(foot.arms @ R.T)[2][2]
    normal *= np.copysign(1.0, normal[2])
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), normal[2])
    if angle > _STEEPEST:
        found = f"{foot.frame} is {np.degrees(angle):.0f} degrees off the horizontal"
        raise InputError.at_field("posture", found, f"joint positions that put it within {np.degrees(_STEEPEST):.0f}")
    return Rotation.from_rotvec(angle * axis / max(float(np.linalg.norm(axis)), 1e-12)).as_matrix() @ R


@dataclass(frozen=True)
class Setpoint:
    """What to do at one instant; `p`, `v`, `a`: position, velocity, acceleration.

    Attributes:
        com: (3, 3), rows p, v, a of the centre of mass, world axes.
        base: rotation of the base, (3, 3).
        base_rate: (2, 3), angular velocity and acceleration, base axes.
        joints: (3, n), rows p, v, a.
        driven: (n,), which joints follow their reference closely; the others yield to everything else.
        feet: (F, 3, 3), rows p, v, a of every foot, world axes.
        load: (F,), the share of its part of the load that a foot takes, 0 in the air.
    """

    com: Array
    base: Array
    base_rate: Array
    joints: Array
    driven: Array
    feet: Array
    load: Array


class Controller:
    """Joint torques from the state of the plant and a setpoint."""

    def __init__(
        self, plant: Plant, feet: tuple[Foot, ...], rotations: Array, friction: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Fix the feet, their rotations to world, (F, 3, 3), which they keep, and the joint friction to make up for."""
        self._plant = plant
        self._coulomb, self._viscous = friction
        self._feet = feet
        self._rotations = rotations
        self._landed: list[tuple[Array, Array] | None] = [None] * len(feet)

    def torque(self, setpoint: Setpoint) -> Array:
        """Torques (n,) [N m] for the plant as last observed."""
        plant = self._plant
        M, bias = plant.inertia, plant.bias
        feet = [plant.foot(i) for i in range(len(self._feet))]
        acceleration = self._acceleration(setpoint, M, bias, feet)
        needed = M @ acceleration + bias
        velocity = plant.velocity[6:] + _PREVIEW * acceleration[6:]
        lost = self._coulomb * np.tanh(velocity / _SMOOTH) + self._viscous * velocity
        joints = (needed - self._contact_forces(needed[:6], setpoint.load, feet))[6:] + lost
        return joints if plant.has_motor.all() else self._of_motors(joints)

    def _of_motors(self, needed: Array) -> Array:
        """Torques (n,) that do what others would, (n,), where some joints have no motor: constraints exert the rest."""
        motors = np.flatnonzero(self._plant.has_motor)
        J, _, _ = self._plant.constraints
        exerted = np.concatenate([np.eye(len(needed))[:, motors], J[:, 6:].T], axis=1)
        out = np.zeros(len(needed))
        out[motors] = np.linalg.lstsq(exerted, needed, rcond=_SINGULAR)[0][: len(motors)]
        return out

    def _acceleration(self, setpoint: Setpoint, M: Array, bias: Array, feet: list[FootMotion]) -> Array:
        """The generalized acceleration (nv,) that meets all tasks best, by weighted least squares."""
        plant = self._plant
        velocity, nv = plant.velocity, plant.nv
        tasks: list[tuple[float, Array, Array]] = []

        com_J = M[:3] / plant.mass  # the base's linear rows are the momentum of everything
        drift = (bias[:3] - plant.weight) / plant.mass
        target = _servo(setpoint.com[0] - plant.com, setpoint.com[1] - com_J @ velocity, setpoint.com[2])
        tasks.append((_CENTRE, com_J, target - drift))

        turn = np.zeros((3, nv))
        turn[:, 3:6] = np.eye(3)
        error = rotation_error(np.eye(3), plant.base_rotation.T @ setpoint.base)
        tasks.append((_TURN, turn, _servo(error, setpoint.base_rate[0] - velocity[3:6], setpoint.base_rate[1])))

        for i, foot in enumerate(feet):
            p, v, a = setpoint.feet[i]
            off = np.concatenate([p - foot.position, rotation_error(foot.rotation, self._rotations[i])])
            if setpoint.load[i] > ALOFT:
                if radius := self._feet[i].rolling_radius:
                    off[:3] = self._rolled_position(i, foot) - foot.position
                    foot = foot.rolling(radius)
                off[2] = 0.0  # the floor gives way
                weight, target = _STANDING, _CREEP * off - _FOOT_DAMPING * foot.velocity
            else:
                self._landed[i] = None
                rate = np.concatenate([v, np.zeros(3)]) - foot.velocity
                weight, target = _SWING, _servo(off, rate, np.concatenate([a, np.zeros(3)]))
            rows = slice(self._feet[i].constrained)
            tasks.append((weight, foot.J[rows], (target - foot.bias)[rows]))

        J_constraints, off, constraint_bias = plant.constraints
        tasks.append((_CONSTRAINED, J_constraints, _servo(-off, -J_constraints @ velocity, -constraint_bias)))

        joints = np.zeros((plant.n, nv))
        joints[:, 6:] = np.diag(np.where(setpoint.driven, _JOINT, _POSTURE))
        p, v, a = setpoint.joints
        tasks.append((1.0, joints, joints[:, 6:] @ _servo(p - plant.position[7:], v - velocity[6:], a)))

        A = np.vstack([weight * J for weight, J, _ in tasks])
        b = np.concatenate([weight * target for weight, _, target in tasks])
        return np.linalg.solve(A.T @ A + 1e-9 * np.eye(nv), A.T @ b)

    def _rolled_position(self, index: int, foot: FootMotion) -> Array:
        """Where the middle of a sphere is that has rolled from where it began to stand, (3,) [m], by its rotation."""
        if self._landed[index] is None:
            self._landed[index] = foot.position.copy(), foot.rotation.copy()
        position, rotation = self._landed[index] or (foot.position, foot.rotation)
        turned = rotation_error(rotation, foot.rotation)
        radius = self._feet[index].rolling_radius
        return np.asarray(position + radius * np.cross(turned, [0.0, 0.0, 1.0]))

    def _contact_forces(self, base: Array, load: Array, feet: list[FootMotion]) -> Array:
        """Generalized force (nv,) of the smallest point forces that give the base what it needs, (6,).

        Points that would have to pull on the floor are dropped, as far as enough others remain.
        """
        maps, shares = [], []
        for foot, share, motion in zip(self._feet, load, feet, strict=True):
            if share <= ALOFT:
                continue
            for arm in foot.arms @ motion.rotation.T - [0.0, 0.0, foot.rolling_radius]:
                maps.append(motion.J[:3] - _cross(arm) @ motion.J[3:])
                shares.append(share)
        J, S = np.vstack(maps), np.array(shares)
        at_base = J[:, :6].T
        for _ in range(_TRIES):
            weighted = at_base * np.repeat(S, 3)
            force = weighted.T @ np.linalg.solve(weighted @ at_base.T, base)
            pulling = force[2::3] < 0.0
            if not pulling.any() or (~pulling & (S > 0.0)).sum() < _LEAST_POINTS:
                break
            S = np.where(pulling, 0.0, S)
        return J.T @ force


def _servo(error: Array, rate_error: Array, feedforward: Array) -> Array:
    return feedforward + _STIFFNESS * error + _DAMPING * rate_error


def _cross(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


BODY = ("com_x", "com_y", "com_z", "base_roll", "base_pitch", "base_yaw")  # what waves move, besides joints
LEAD_S = 2.0  # waves grow to their amplitude in this time, before the log begins


class ReferenceMotion:
    """The reference of a motion from a stance: a setpoint for every control step from -LEAD_S to its end.

    Args:
        config: waves and steps.
        stance: where it starts.
        joint_names: of the robot, in the plant's order.
        feet: frames of the feet.
        control_hz: control rate [Hz].

    Raises:
        UnknownNameError: a wave moves something that the robot does not have.
        InputError: it is too short, or faster than can be controlled.
    """

    def __init__(
        self,
        config: MotionConfig,
        stance: Stance,
        joint_names: Sequence[str],
        feet: Sequence[str],
        control_hz: float,
    ) -> None:
        self.name = config.name
        self._stance = stance
        names = (*BODY, *joint_names)
        if config.duration_s * control_hz < 2.0:
            accepted = f"at least two control steps, {2.0 / control_hz:g} s"
            raise InputError.at_field(f"motions.{config.name}.duration_s", f"{config.duration_s:g}", accepted)
        steps = round((LEAD_S + config.duration_s) * control_hz)
        self.time = np.arange(steps) / control_hz - LEAD_S
        grown = _smooth((self.time + LEAD_S) / LEAD_S)
        moved = np.zeros((steps, len(names)))
        for index, wave in enumerate(config.waves):
            if wave.what not in names:
                raise UnknownNameError.at_field(f"motions.{config.name}.waves.{index}.what", wave.what, names)
            if wave.hz >= 0.5 * control_hz:
                accepted = f"below {0.5 * control_hz:g}, half of control_hz"
                raise InputError.at_field(f"motions.{config.name}.waves.{index}.hz", f"{wave.hz:g}", accepted)
            sine = np.sin(2.0 * np.pi * (wave.hz * self.time + wave.phase))
            moved[:, names.index(wave.what)] += wave.amplitude * grown * sine
        self._moved = _with_derivatives(moved, control_hz)
        self._driven = np.array([any(wave.what == name for wave in config.waves) for name in joint_names])
        if config.steps and config.steps.swing_s + 2.0 * config.steps.transfer_s > 1.0 / config.steps.hz:
            found = f"{config.steps.swing_s:g} in the air and twice {config.steps.transfer_s:g} to transfer the load"
            accepted = f"at most the period of {1.0 / config.steps.hz:g} s together"
            raise InputError.at_field(f"motions.{config.name}.steps.swing_s", found, accepted)
        for frame in config.steps.order if config.steps else ():
            if frame not in feet:
                raise UnknownNameError.at_field(f"motions.{config.name}.steps.order", frame, feet)
        height, self._load = _steps(config.steps, feet, self.time)
        self._lift = _with_derivatives(height, control_hz)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def supports(self) -> BoolArray:
        """The sets of feet, (S, F), that carry the robot at one time or another."""
        return np.unique(self._load > ALOFT, axis=0)

    def __iter__(self) -> Iterator[Setpoint]:
        """The setpoints, one per control step."""
        stance = self._stance
        n = self._moved.shape[2] - len(BODY)
        rest = np.zeros((3, 3 + n))
        rest[0] = [*stance.com, *stance.position[7:]]
        feet = np.zeros((len(stance.feet), 3, 3))
        feet[:, 0] = stance.feet
        turns = Rotation.from_rotvec(self._moved[0, :, 3:6]).as_matrix()
        for i in range(len(self)):
            moved = self._moved[:, i]
            lifted = feet.copy()
            lifted[:, :, 2] += self._lift[:, i].T
            yield Setpoint(
                com=rest[:, :3] + moved[:, :3],
                base=turns[i],
                base_rate=moved[1:, 3:6],
                joints=rest[:, 3:] + moved[:, 6:],
                driven=self._driven,
                feet=lifted,
                load=self._load[i],
            )


def _steps(steps: StepsConfig | None, feet: Sequence[str], time: Array) -> tuple[Array, Array]:
    """Height (T, F) [m] and share of the load (T, F) of every foot, lifted in turn from time 0 on."""
    height, load = np.zeros((len(time), len(feet))), np.ones((len(time), len(feet)))
    if steps is None:
        return height, load
    for turn, frame in enumerate(steps.order):
        foot = feet.index(frame)
        middle = (turn + 0.5) / len(steps.order)
        off = ((time * steps.hz - middle + 0.5) % 1.0 - 0.5) / steps.hz  # s from the middle of the swing
        inside = 1.0 - np.abs(off) / (0.5 * steps.swing_s)
        stepping = time - off > 0.5 * steps.swing_s + steps.transfer_s  # not if it had to begin before time 0
        height[:, foot] += np.where(stepping & (inside > 0.0), steps.height_m * _bump(inside), 0.0)
        unloaded = (np.abs(off) - 0.5 * steps.swing_s) / steps.transfer_s
        load[:, foot] = np.minimum(load[:, foot], np.where(stepping, _smooth(unloaded), 1.0))
    return height, load


def _with_derivatives(x: Array, hz: float) -> Array:
    """`x`, (T, ...), and its first two derivatives, (3, T, ...)."""
    rate = np.gradient(x, 1.0 / hz, axis=0)
    return np.stack([x, rate, np.gradient(rate, 1.0 / hz, axis=0)])


def _smooth(u: Array) -> Array:
    """From 0 (u <= 0) to 1 (u >= 1) with two continuous derivatives."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def _bump(u: Array) -> Array:
    """1 in the middle of a swing (u = 1), 0 at its ends (u = 0), where it starts with a strong acceleration."""
    u = np.clip(u, 0.0, 1.0)
    return u**2 * (2.0 - u) ** 2
