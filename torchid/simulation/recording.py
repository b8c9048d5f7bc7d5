"""Run a motion and record what truly happened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from torchid.config import SimulationConfig
from torchid.errors import InputError, LogError
from torchid.logs import Log
from torchid.parameters import Array
from torchid.simulation.controller import Controller
from torchid.simulation.motion import Motion
from torchid.simulation.plant import Plant
from torchid.simulation.stance import Stance

_REPORT_S = 0.25  # simulated seconds between two looks at how the robot stands


@dataclass(frozen=True)
class Recording:
    """One motion as it truly was, sampled at the physics rate from time 0 on.

    `log` holds exact states, the simulator's accelerations, torques and wrenches, and a contact as active while
    the floor acts on the foot at all. `feet`, (N, F, 3) [m], and `rotations`, (N, F, 3, 3), are the poses of the feet's
    frames.
    """

    log: Log
    feet: Array
    rotations: Array


def exact(log: Log, name: str) -> Array:
    """A field of a truth log.

    Raises:
        LogError: the log lacks it.
    """
    values: Array | None = getattr(log, name)
    if values is None:
        raise LogError(log.source, name, "missing", "an exact log that torchid simulate wrote")
    return values


def record(
    plant: Plant,
    controller: Controller,
    stance: Stance,
    motion: Motion,
    config: SimulationConfig,
    source: object,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Simulate a motion.

    Args:
        plant: the robot.
        controller: what drives it.
        stance: where it starts.
        motion: what it does.
        config: rates, and the height that the base must keep.
        source: named in errors.
        progress: called with the seconds simulated since the last call.

    Raises:
        InputError: the robot falls.
    """
    plant.place(stance.position)
    frames: list[tuple[Array, ...]] = []
    per_goal = round(config.physics_hz / config.control_hz)
    report_every = max(1, round(config.control_hz * _REPORT_S))
    for step, (time, goal) in enumerate(zip(motion.time, motion, strict=True)):
        for substep in range(per_goal):
            plant.observe()
            if substep == 0:
                torque = controller.torque(goal)
            before = [x.copy() for x in (plant.position, plant.velocity, plant.feet_positions, plant.feet_rotations)]
            plant.push(torque)
            if time >= 0.0:
                frames.append((*before, plant.acceleration.copy(), torque, plant.wrenches))
        if step % report_every == 0:
            if plant.unstable or not abs(plant.position[2] - stance.position[2]) <= config.bounds.height_m:
                when = f"at {time:.2f} s" if time >= 0.0 else f"{-time:.2f} s before the log begins"
                found, wanted = f"the robot falls {when}", "a gentler motion, or another posture"
                raise InputError(source, f"motions.{motion.name}", found, wanted)
            if progress is not None:
                progress(report_every / config.control_hz)
    position, velocity, feet, rotations, *pushed = (np.array(x) for x in zip(*frames, strict=True))
    log = _exact_log(plant, motion.name, config.physics_hz, position, velocity, *pushed)
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
