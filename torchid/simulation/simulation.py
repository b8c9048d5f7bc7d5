"""Simulated motions: stance, reference and controller, exact recording, stability, and sensor readings."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from torchid.config import BoundsConfig, MotionConfig, SensorImperfectionsConfig, SimulationConfig, StepsConfig
from torchid.config.robot import require_kind
from torchid.errors import InputError, LogError, UnknownNameError
from torchid.logs import Log
from torchid.logs.log import BoolArray
from torchid.parameters import Array
from torchid.problem.base_pose import rolled_distance
from torchid.sensing.sensors import NORMAL_INDEX
from torchid.simulation.plant import Foot, FootMotion, Plant, find_feet, form_polygon, rotation_error

_STIFFNESS = 100.0  # 1/s^2: errors decay within half a second, without overshoot
_DAMPING = 20.0  # 1/s
_CREEP = 100.0  # 1/s^2, of a foot that stands: friction holds it, but lets it creep
_FOOT_DAMPING = 20.0  # 1/s
_CONSTRAINED = 1000.0  # weights of tasks
_STANDING = 100.0
_CENTRE = 10.0
_TURN = 10.0
_SWING = 10.0
_JOINT = 3.0
_POSTURE = 0.05
ALOFT = 1e-3  # a foot that carries a smaller share than this is off the floor
_PREVIEW = 0.02  # s: friction is that of the velocity to come
_SMOOTH = 0.05  # rad/s, where friction turns
_TRIES = 3
_LEAST_POINTS = 3
_ITERATIONS = 300
_LARGEST_STEP = 0.2
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
    """Put the robot on its feet near a posture, with a level base and the centre of mass above the middle of the feet.

    Args:
        plant: the robot; it is left in the stance.
        feet: that stand.
        posture: joint positions by name [rad or m]; others are 0, or the nearest limit.

    Raises:
        UnknownNameError: the robot has no such joint.
        InputError: a joint is beyond its limits, or there is no such configuration near the posture.
    """
    for name in posture:
        if name not in plant.joint_names:
            raise UnknownNameError.at_field("posture", name, plant.joint_names)
    low, high = plant.limits.T
    for name, value in posture.items():
        joint = plant.joint_names.index(name)
        if not low[joint] <= value <= high[joint]:
            accepted = f"{low[joint]:g} to {high[joint]:g} (the joint's limits)"
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
        reason = f"not near a stance with all feet on the floor and a level base (off by {worst:.2g} m or rad)"
        raise InputError.at_field("posture", reason, "joint positions by name, close to a standing posture")
    return Stance(plant.position.copy(), plant.com.copy(), targets, rotations)


def _tasks(plant: Plant, feet: Sequence[Foot], targets: Array, rotations: Array) -> tuple[Array, Array]:
    """What should be zero: Jacobian (rows, nv), and how far off it is (rows,) [m, rad]."""
    jacobians = []
    off = []
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
        reason = f"{foot.frame} is {np.degrees(angle):.0f} deg off the horizontal"
        raise InputError.at_field("posture", reason, f"joint positions with at most {np.degrees(_STEEPEST):.0f} deg")
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
        """Set the feet, their constant rotations to world, (F, 3, 3), and the joint friction to compensate."""
        self._plant = plant
        self._coulomb, self._viscous = friction
        self._feet = feet
        self._rotations = rotations
        self._landed: list[tuple[Array, Array] | None] = [None] * len(feet)

    def torque(self, setpoint: Setpoint) -> Array:
        """Torques (n,) [N m] for the plant as last observed."""
        plant = self._plant
        M = plant.inertia
        bias = plant.bias
        feet = [plant.foot(i) for i in range(len(self._feet))]
        acceleration = self._acceleration(setpoint, M, bias, feet)
        needed = M @ acceleration + bias
        velocity = plant.velocity[6:] + _PREVIEW * acceleration[6:]
        lost = self._coulomb * np.tanh(velocity / _SMOOTH) + self._viscous * velocity
        joints = (needed - self._contact_forces(needed[:6], setpoint.load, feet))[6:] + lost
        return joints if plant.has_motor.all() else self._of_motors(joints)

    def _of_motors(self, needed: Array) -> Array:
        """Torques (n,) of the motors that replace torques (n,) of all joints; constraints transmit the rest."""
        motors = np.flatnonzero(self._plant.has_motor)
        J, _, _ = self._plant.constraints
        exerted = np.concatenate([np.eye(len(needed))[:, motors], J[:, 6:].T], axis=1)
        out = np.zeros(len(needed))
        out[motors] = np.linalg.lstsq(exerted, needed, rcond=_SINGULAR)[0][: len(motors)]
        return out

    def _acceleration(self, setpoint: Setpoint, M: Array, bias: Array, feet: list[FootMotion]) -> Array:
        """The generalized acceleration (nv,) that meets all tasks best, by weighted least squares."""
        plant = self._plant
        velocity = plant.velocity
        nv = plant.nv
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
                weight = _STANDING
                target = _CREEP * off - _FOOT_DAMPING * foot.velocity
            else:
                self._landed[i] = None
                rate = np.concatenate([v, np.zeros(3)]) - foot.velocity
                weight = _SWING
                target = _servo(off, rate, np.concatenate([a, np.zeros(3)]))
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
        """Generalized force (nv,) of the smallest point forces that give the base a required wrench, (6,).

        Points that would have to pull on the floor are dropped, as long as enough others remain.
        """
        maps = []
        shares = []
        for foot, share, motion in zip(self._feet, load, feet, strict=True):
            if share <= ALOFT:
                continue
            for arm in foot.arms @ motion.rotation.T - [0.0, 0.0, foot.rolling_radius]:
                maps.append(motion.J[:3] - _cross(arm) @ motion.J[3:])
                shares.append(share)
        J = np.vstack(maps)
        S = np.array(shares)
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
            accepted = f"at least {2.0 / control_hz:g} s (two control steps)"
            raise InputError.at_field(f"motions.{config.name}.duration_s", f"{config.duration_s:g}", accepted)
        steps = round((LEAD_S + config.duration_s) * control_hz)
        self.time = np.arange(steps) / control_hz - LEAD_S
        grown = _smooth((self.time + LEAD_S) / LEAD_S)
        moved = np.zeros((steps, len(names)))
        for index, wave in enumerate(config.waves):
            if wave.what not in names:
                raise UnknownNameError.at_field(f"motions.{config.name}.waves.{index}.what", wave.what, names)
            if wave.hz >= 0.5 * control_hz:
                accepted = f"below {0.5 * control_hz:g} (half of control_hz)"
                raise InputError.at_field(f"motions.{config.name}.waves.{index}.hz", f"{wave.hz:g}", accepted)
            sine = np.sin(2.0 * np.pi * (wave.hz * self.time + wave.phase))
            moved[:, names.index(wave.what)] += wave.amplitude * grown * sine
        self._moved = _with_derivatives(moved, control_hz)
        self._driven = np.array([any(wave.what == name for wave in config.waves) for name in joint_names])
        if config.steps and config.steps.swing_s + 2.0 * config.steps.transfer_s > 1.0 / config.steps.hz:
            reason = f"{config.steps.swing_s:g} s in the air and 2 x {config.steps.transfer_s:g} s to transfer the load"
            accepted = f"at most {1.0 / config.steps.hz:g} s in sum (1 / steps.hz)"
            raise InputError.at_field(f"motions.{config.name}.steps.swing_s", reason, accepted)
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
        standing = np.zeros((3, 3 + n))
        standing[0] = [*stance.com, *stance.position[7:]]
        feet = np.zeros((len(stance.feet), 3, 3))
        feet[:, 0] = stance.feet
        turns = Rotation.from_rotvec(self._moved[0, :, 3:6]).as_matrix()
        for i in range(len(self)):
            moved = self._moved[:, i]
            lifted = feet.copy()
            lifted[:, :, 2] += self._lift[:, i].T
            yield Setpoint(
                com=standing[:, :3] + moved[:, :3],
                base=turns[i],
                base_rate=moved[1:, 3:6],
                joints=standing[:, 3:] + moved[:, 6:],
                driven=self._driven,
                feet=lifted,
                load=self._load[i],
            )


def _steps(steps: StepsConfig | None, feet: Sequence[str], time: Array) -> tuple[Array, Array]:
    """Height (T, F) [m] and share of the load (T, F) of every foot, lifted in turn from time 0 on."""
    height = np.zeros((len(time), len(feet)))
    load = np.ones((len(time), len(feet)))
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


_REPORT_S = 0.25  # simulated seconds between two checks of whether the robot stands


def set_up_simulation(config: SimulationConfig) -> Simulation:
    """Put the robot on its feet. Raises InputError: the URDF, the feet or the posture cannot be simulated."""
    require_kind(config.robot)
    feet = find_feet(config.feet, config.robot.path)
    plant = Plant(config.robot.path, feet, config.physics_hz, config.friction.levels, config.robot)
    simulation = Simulation(config, plant, feet, find_stance(plant, feet, config.posture))
    simulation.require_support(np.ones(len(feet), dtype=bool), "feet")
    return simulation


@dataclass(frozen=True)
class Simulation:
    """A robot on its feet, ready to move."""

    config: SimulationConfig
    plant: Plant
    feet: tuple[Foot, ...]
    stance: Stance

    def require_support(self, support: BoolArray, field: str) -> None:
        """Raise InputError if the contact points of feet, (F,) bool, lie on one line."""
        standing = zip(self.feet, self.stance.feet, self.stance.rotations, support, strict=True)
        points = [middle + foot.arms @ R.T for foot, middle, R, on in standing if on]
        if not points or not form_polygon(np.concatenate(points)):
            names = ", ".join(foot.frame for foot, on in zip(self.feet, support, strict=True) if on)
            reason = f"all contact points of {names} lie on one line" if names else "no foot on the floor"
            raise InputError.at_field(field, reason, "at any time three contact points that form a triangle")

    def reference(self, config: MotionConfig) -> ReferenceMotion:
        """The reference of a motion: a setpoint for every control step.

        Raises:
            UnknownNameError: the robot does not have what a wave moves.
            InputError: the motion is too short, or lifts feet that the robot needs.
        """
        plant = self.plant
        hz = self.config.control_hz
        motion = ReferenceMotion(config, self.stance, plant.joint_names, plant.foot_frames, hz)
        for support in motion.supports:
            self.require_support(support, f"motions.{config.name}.steps")
        return motion

    def run(self, config: MotionConfig, progress: Callable[[float], None] | None = None) -> tuple[Recording, Stability]:
        """Simulate a motion.

        Args:
            config: the motion.
            progress: called with the seconds simulated since the last call.

        Raises:
            InputError: the robot falls, slips, or its zero-moment point leaves the bounds.
        """
        recording = record(self, self.reference(config), progress)
        stability = _measure_stability(self, recording)
        stability.require_within(self.config.bounds, config.name)
        return recording, stability


@dataclass(frozen=True)
class Recording:
    """One motion as it truly was, sampled at the physics rate from time 0 on.

    `log` holds exact states, the simulator's accelerations, torques and wrenches, the force along the normal of feet
    that read it, and a contact as active while the floor acts on the foot at all. `feet`, (N, F, 3) [m], and
    `rotations`, (N, F, 3, 3), are the poses of the feet's frames.
    """

    log: Log
    feet: Array
    rotations: Array


def record(
    simulation: Simulation, motion: ReferenceMotion, progress: Callable[[float], None] | None = None
) -> Recording:
    """Simulate a motion.

    Args:
        simulation: the robot in its stance, the rates, and the height that its base must keep.
        motion: what it does.
        progress: called with the seconds simulated since the last call.

    Raises:
        InputError: the robot falls.
    """
    config = simulation.config
    plant = simulation.plant
    stance = simulation.stance
    controller = Controller(plant, simulation.feet, stance.rotations, config.friction.levels or (0.0, 0.0))
    plant.place(stance.position)
    frames: list[tuple[Array, ...]] = []
    per_setpoint = round(config.physics_hz / config.control_hz)
    report_every = max(1, round(config.control_hz * _REPORT_S))
    for step, (time, setpoint) in enumerate(zip(motion.time, motion, strict=True)):
        for substep in range(per_setpoint):
            plant.observe()
            if substep == 0:
                torque = controller.torque(setpoint)
            before = [x.copy() for x in (plant.position, plant.velocity, plant.feet_positions, plant.feet_rotations)]
            plant.push(torque)
            if time >= 0.0:
                frames.append((*before, plant.acceleration.copy(), torque, plant.wrenches))
        if step % report_every == 0:
            if plant.unstable or not abs(plant.position[2] - stance.position[2]) <= config.bounds.height_m:
                when = f"at {time:.2f} s" if time >= 0.0 else f"{-time:.2f} s before the log begins"
                accepted = "a slower or smaller motion, or another posture"
                raise InputError.at_field(f"motions.{motion.name}", f"the robot falls {when}", accepted)
            if progress is not None:
                progress(report_every / config.control_hz)
    position, velocity, feet, rotations, *pushed = (np.array(x) for x in zip(*frames, strict=True))
    log = _exact_log(plant, motion.name, config.physics_hz, position, velocity, *pushed)
    along = np.array([foot.along_normal for foot in simulation.feet])
    if along.any():
        up = np.einsum("nfi,nfi->nf", rotations[:, :, 2], _require_field(log, "contact_wrench_local")[..., :3])
        log = replace(log, contact_force_normal=np.where(along, up, np.nan))
    return Recording(log, feet, rotations)


def _exact_log(plant: Plant, name: str, hz: float, position: Array, velocity: Array, *pushed: Array) -> Log:
    """The log of samples in the plant's coordinates; `pushed`: accelerations, torques, wrenches."""
    acceleration, torque, wrench = pushed
    return Log(
        name,
        time=np.arange(len(position)) / hz,
        joint_names=plant.joint_names,
        joint_position=position[:, 7:],
        joint_velocity=velocity[:, 6:],
        joint_acceleration=acceleration[:, 6:],
        joint_torque=torque,
        base_position_world=position[:, :3],
        base_quat_xyzw=position[:, [4, 5, 6, 3]],
        base_linear_velocity_world=velocity[:, :3],
        base_angular_velocity_base=velocity[:, 3:6],
        base_linear_acceleration_world=acceleration[:, :3],
        base_angular_acceleration_base=acceleration[:, 3:6],
        contact_names=plant.foot_frames,
        contact_active=np.any(wrench != 0.0, axis=2),
        contact_wrench_local=wrench,
    )


@dataclass(frozen=True)
class Stability:
    """How a robot stood during a motion.

    Attributes:
        base_height: least and greatest height of the base's origin [m].
        height_change: most that it differed from the stance's [m].
        slip: most that a foot moved along the floor, beyond rolling, between touching it and leaving it [m].
        zmp_margin: least distance from the zero-moment point to the border of the support polygon [m].
        beyond_limits: most that a joint was outside its range [rad or m].
        effort: greatest torque as a share of what the URDF allows, 0 if it sets no limit.
        unloaded: share of the time in which each foot did not stand, (F,).
    """

    base_height: tuple[float, float]
    height_change: float
    slip: float
    zmp_margin: float
    beyond_limits: float
    effort: float
    unloaded: tuple[float, ...]

    def require_within(self, bounds: BoundsConfig, motion: str) -> None:
        """Raise InputError if the robot left the bounds of standing."""
        for measured, allowed in (
            (f"the base height changes by {self.height_change:.3g} m", self.height_change <= bounds.height_m),
            (f"a foot slips by {1e3 * self.slip:.3g} mm", self.slip <= bounds.slip_m),
            (f"the ZMP is {1e3 * self.zmp_margin:.3g} mm inside the support polygon", self.zmp_margin >= bounds.zmp_m),
            (f"a joint is {self.beyond_limits:.3g} rad or m outside its limits", self.beyond_limits <= 0.0),
            (f"a joint needs {100 * self.effort:.0f} % of its effort limit", self.effort <= 1.0),
        ):
            if not allowed:
                accepted = "a slower or smaller motion, another posture or wider bounds"
                raise InputError.at_field(f"motions.{motion}", measured, accepted)


def _measure_stability(simulation: Simulation, recording: Recording) -> Stability:
    """Measure how a robot stood; a foot stands from a vertical force of `sensors.contact_threshold` [N] on.

    Raises:
        InputError: a foot never bears that much.
    """
    log = recording.log
    load = simulation.config.sensors.contact_threshold
    plant = simulation.plant
    stance = simulation.stance
    feet = simulation.feet
    wrench = _require_field(log, "contact_wrench_local")
    R = recording.rotations
    force, moment = ((R @ part[..., None])[..., 0] for part in (wrench[..., :3], wrench[..., 3:]))
    middles = recording.feet + np.einsum("nfij,fj->nfi", R, np.array([foot.middle for foot in feet]))
    for i, foot in enumerate(feet):
        if foot.rolling_radius:
            middles[:, i] -= rolled_distance(R[:, i], foot.rolling_radius, np.array([0.0, 0.0, 1.0]))
    standing = force[..., 2] > load
    bearing = np.linalg.norm(force, axis=2).max(axis=0)
    for foot, most in zip(feet, bearing, strict=True):
        if most <= load:
            reason = f"{load:g} N, but the force at {foot.frame} is at most {most:.3g} N"
            accepted = "a fraction of the load on a standing foot"
            raise InputError.at_field("sensors.contact_threshold", reason, accepted)
    low, high = plant.limits.T
    height = _require_field(log, "base_position_world")[:, 2]
    return Stability(
        (float(height.min()), float(height.max())),
        float(np.abs(height - stance.position[2]).max()),
        max(_slip(middles[:, i, :2], standing[:, i]) for i in range(len(feet))),
        _zmp_margin(recording.feet, force, moment, stance, feet),
        max(float((log.joint_position - high).max()), float((low - log.joint_position).max()), 0.0),
        float(np.max(np.abs(_require_field(log, "joint_torque")) / plant.efforts)),
        tuple(map(float, 1.0 - standing.mean(axis=0))),
    )


def _slip(position: Array, standing: BoolArray) -> float:
    """Most that a point, (N, 2), moved from where it was when it began to stand."""
    begins = np.flatnonzero(np.diff(standing.astype(int), prepend=0) == 1)
    if not len(begins):
        return 0.0
    began = begins[np.maximum(np.cumsum(np.isin(np.arange(len(position)), begins)) - 1, 0)]
    return float(np.linalg.norm(position - position[began], axis=1)[standing].max())


def _zmp_margin(position: Array, force: Array, moment: Array, stance: Stance, feet: tuple[Foot, ...]) -> float:
    """Least distance from the zero-moment point to the border of the support polygon, per set of feet on the floor."""
    arm = np.cross(position, force) + moment
    total = force.sum(axis=1)
    turning = arm.sum(axis=1)
    aloft = total[:, 2] < 1.0
    zmp = np.stack([-turning[:, 1], turning[:, 0]], axis=1) / np.where(aloft, np.nan, total[:, 2])[:, None]
    corners = [
        target[:2] + (foot.arms @ R.T)[:, :2]
        for target, R, foot in zip(stance.feet, stance.rotations, feet, strict=True)
    ]
    margin = np.inf if not aloft.any() else -np.inf
    on = force[..., 2] > 0.0
    for state in np.unique(on[~aloft], axis=0):
        support = np.concatenate([corner for corner, active in zip(corners, state, strict=True) if active])
        if len(support) < 3:
            return -np.inf
        hull = ConvexHull(support).equations
        inside = zmp[(on == state).all(axis=1)]
        margin = min(margin, float(-(inside @ hull[:, :2].T + hull[:, 2]).max()))
    return margin


def sensor_log(truth: Log, sensors: SensorImperfectionsConfig, seed: int, name: str | None = None) -> Log:
    """The log that a robot with imperfect sensors would record.

    It has positions, torques and wrenches; preprocessing derives velocities and accelerations. A foot with
    `contact_force_normal` in the exact log has only this reading. A contact is active while the measured force (of
    wrenches: along its mean over the log) exceeds the threshold.

    Args:
        truth: exact log, of a `Recording`.
        sensors: imperfections of the sensors.
        seed: of the noise, together with `name`; biases and gains depend on the seed alone.
        name: of the motion, by default the log's source; becomes the source.

    Raises:
        InputError: the delay is shorter than one sample or longer than the log.
    """
    name = name or truth.source
    torque = _require_field(truth, "joint_torque")
    wrench, along = _foot_readings(truth)
    if sensors.delay.enabled:
        step = float(np.median(np.diff(truth.time)))
        late = round(sensors.delay.feet_s / step)
        if late >= len(truth) or (late == 0 and sensors.delay.feet_s > 0.0):
            accepted = f"0, or from {step:g} s (one sample) to below {len(truth) * step:g} s (the log)"
            raise InputError(name, "sensors.delay.feet_s", f"{sensors.delay.feet_s:g}", accepted)
        wrench = wrench[np.maximum(np.arange(len(truth)) - late, 0)]  # the first reading is held
    if sensors.bias.enabled:
        torque, wrench = _biased(torque, wrench, sensors, np.random.default_rng([seed, 0]))
    position, base, turn = (
        _require_field(truth, f) for f in ("joint_position", "base_position_world", "base_quat_xyzw")
    )
    if sensors.noise.enabled:
        rng = np.random.default_rng([seed, 1, zlib.crc32(name.encode())])
        noise = sensors.noise

        def noisy(values: Array, deviation: float | Array) -> Array:
            return values + deviation * rng.normal(size=values.shape)

        position = noisy(position, noise.joint_position)
        base = noisy(base, noise.base_position)
        turns = Rotation.from_rotvec(noise.base_orientation * rng.normal(size=(len(truth), 3)))
        turn = (Rotation.from_quat(turn) * turns).as_quat()
        torque = noisy(torque, noise.joint_torque)
        wrench = noisy(wrench, np.repeat([noise.contact_force, noise.contact_moment], 3))
    force = wrench[..., NORMAL_INDEX]
    return Log(
        name,
        time=truth.time,
        joint_names=truth.joint_names,
        joint_position=position,
        joint_torque=torque,
        base_position_world=base,
        base_quat_xyzw=turn,
        contact_names=truth.contact_names,
        contact_active=np.where(along, force > sensors.contact_threshold, _loaded(wrench, sensors.contact_threshold)),
        contact_wrench_local=None if along.all() else np.where(along[:, None], np.nan, wrench),
        contact_force_normal=np.where(along, force, np.nan) if along.any() else None,
    )


def _foot_readings(truth: Log) -> tuple[Array, BoolArray]:
    """Wrenches on the feet (N, F, 6), of those that read along the normal their reading as fz; and which these are.

    As wrenches all feet get the noise, bias and gain that they have whatever some of them read.
    """
    wrench = _require_field(truth, "contact_wrench_local")
    force = truth.contact_force_normal
    if force is None:
        return wrench, np.zeros(wrench.shape[1], dtype=bool)
    along: BoolArray = np.asarray(np.isfinite(force).any(axis=0))
    scalar = force[..., None] * (np.arange(6) == NORMAL_INDEX)
    return np.where(along[:, None], scalar, wrench), along


def _biased(
    torque: Array, wrench: Array, sensors: SensorImperfectionsConfig, rng: np.random.Generator
) -> tuple[Array, Array]:
    levels = sensors.bias
    offset = np.repeat([levels.contact_force, levels.contact_moment], 3)
    return (
        torque * (1.0 + levels.gain * rng.normal(size=torque.shape[1]))
        + levels.joint_torque * rng.normal(size=torque.shape[1]),
        wrench * (1.0 + levels.gain * rng.normal(size=wrench.shape[1:])) + offset * rng.normal(size=wrench.shape[1:]),
    )


def _loaded(wrench: Array, threshold: float) -> BoolArray:
    """Which feet stand, (N, F): force along its mean direction above the threshold."""
    force = wrench[..., :3]
    mean = force.mean(axis=0)
    direction = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return np.einsum("nfi,fi->nf", force, direction) > threshold


def _require_field(log: Log, name: str) -> Array:
    """A field of an exact log, which must have it. Raises LogError: the log lacks it."""
    values: Array | None = getattr(log, name)
    if values is None:
        raise LogError(log.source, name, "missing", "an exact log from torchid simulate")
    return values
