"""Motions of a simulation file: a robot put on its feet, an exact recording, how it stood, what its sensors read."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from torchid.config import BoundsConfig, MotionConfig, SensorImperfectionsConfig, SimulationConfig
from torchid.config.robot import require_kind
from torchid.errors import InputError, LogError
from torchid.logs import Log
from torchid.logs.log import BoolArray
from torchid.parameters import Array
from torchid.problem.floor_pose import rolled_distance
from torchid.sensing.sensors import NORMAL_INDEX
from torchid.simulation.controller import Controller, ReferenceMotion, Stance, find_stance
from torchid.simulation.plant import Foot, Plant, find_feet, form_polygon

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
        """Require that feet, (F,) bool, can support a robot. Raises InputError: their contact points lie on a line."""
        standing = zip(self.feet, self.stance.feet, self.stance.rotations, support, strict=True)
        points = [middle + foot.arms @ R.T for foot, middle, R, on in standing if on]
        if not points or not form_polygon(np.concatenate(points)):
            names = ", ".join(foot.frame for foot, on in zip(self.feet, support, strict=True) if on)
            found = f"stands on {names} alone, whose contact points lie on a line" if names else "no foot on the floor"
            raise InputError.at_field(field, found, "three points on the floor that do not, at any time")

    def reference(self, config: MotionConfig) -> ReferenceMotion:
        """The reference of a motion: a setpoint for every control step.

        Raises:
            UnknownNameError: it moves what the robot does not have.
            InputError: it is too short, or lifts feet that the robot cannot do without.
        """
        plant, hz = self.plant, self.config.control_hz
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
    config, plant, stance = simulation.config, simulation.plant, simulation.stance
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
                accepted = "a gentler motion, or another posture"
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
        """Require that the robot stayed within the bounds of standing. Raises InputError: a bound is broken."""
        for found, allowed in (
            (f"base height changes by {self.height_change:.3g} m", self.height_change <= bounds.height_m),
            (f"a foot slips by {1e3 * self.slip:.3g} mm", self.slip <= bounds.slip_m),
            (f"zero-moment point {1e3 * self.zmp_margin:.3g} mm inside the support", self.zmp_margin >= bounds.zmp_m),
            (f"a joint passes its limits by {self.beyond_limits:.3g}", self.beyond_limits <= 0.0),
            (f"a joint needs {100 * self.effort:.0f} % of its effort limit", self.effort <= 1.0),
        ):
            if not allowed:
                accepted = "a gentler motion, another posture or wider bounds"
                raise InputError.at_field(f"motions.{motion}", found, accepted)


def _measure_stability(simulation: Simulation, recording: Recording) -> Stability:
    """Measure how a robot stood; a foot stands from a vertical force of `sensors.contact_threshold` [N] on.

    Raises:
        InputError: a foot never bears that much.
    """
    log, load = recording.log, simulation.config.sensors.contact_threshold
    plant, stance, feet = simulation.plant, simulation.stance, simulation.feet
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
            found = f"{load:g} N, but {foot.frame} never bears more than {most:.3g} N"
            accepted = "a fraction of what a standing foot bears"
            raise InputError.at_field("sensors.contact_threshold", found, accepted)
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
    total, turning = force.sum(axis=1), arm.sum(axis=1)
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
    """The log that a robot with imperfect sensors would have written.

    Positions, torques and wrenches only: velocities and accelerations are for the preprocessing to derive. A foot whose
    exact log has `contact_force_normal` reads this alone. A contact is active while the measured force, of wrenches
    along its mean over the log, exceeds the threshold.

    Args:
        truth: exact log, of a `Recording`.
        sensors: which imperfections, and how large.
        seed: of the noise, together with `name`; biases and gains depend on the seed alone.
        name: of the motion, by default the log's source; becomes the source.

    Raises:
        InputError: a delay of no sample, or of all.
    """
    name = name or truth.source
    torque, wrench, along = _require_field(truth, "joint_torque"), *_foot_readings(truth)
    if sensors.delay.enabled:
        step = float(np.median(np.diff(truth.time)))
        late = round(sensors.delay.feet_s / step)
        if late >= len(truth) or (late == 0 and sensors.delay.feet_s > 0.0):
            accepted = f"0, or from one sample, {step:g} s, to less than the log, {len(truth) * step:g} s"
            raise InputError(name, "sensors.delay.feet_s", f"{sensors.delay.feet_s:g}", accepted)
        wrench = wrench[np.maximum(np.arange(len(truth)) - late, 0)]  # the first reading is held
    if sensors.bias.enabled:
        torque, wrench = _biased(torque, wrench, sensors, np.random.default_rng([seed, 0]))
    position, base, turn = (
        _require_field(truth, f) for f in ("joint_position", "base_position_world", "base_quat_xyzw")
    )
    if sensors.noise.enabled:
        rng, noise = np.random.default_rng([seed, 1, zlib.crc32(name.encode())]), sensors.noise

        def noisy(values: Array, deviation: float | Array) -> Array:
            return values + deviation * rng.normal(size=values.shape)

        position, base = noisy(position, noise.joint_position), noisy(base, noise.base_position)
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
    wrench, force = _require_field(truth, "contact_wrench_local"), truth.contact_force_normal
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
        raise LogError(log.source, name, "missing", "an exact log that torchid simulate wrote")
    return values
