"""Replay of a log's joint torques on a simulated robot, in windows that start at the log's state, and the drift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout
from scipy.spatial.transform import Rotation, Slerp

from torchid.errors import InputError, LogError
from torchid.parameters import Array
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.simulation.plant import Followers, Foot, JointConstraints, compile_model, foot_site

_PHYSICS_HZ = 1000.0
# Rates of decay by damping [1/s] from _PHYSICS_HZ on are for an implicit integrator: Runge and Kutta's would diverge.
_LONGEST_GAP = 2.5  # median sampling intervals, within a window
_FEWEST = 2  # sampling intervals of a window
_MOST_WINDOWS = 500


@dataclass(frozen=True)
class ReplayedLog:
    """The replayed part of a log with N samples.

    Attributes:
        source: its name.
        time: (N,) [s].
        position, velocity: (N, n), of the joints [rad or m, rad/s or m/s].
        torque: (N, n), of the joints [N m or N].
        quat_xyzw: (N, 4), base to world; None for an upright fixed base.
        angular_velocity: (N, 3), of the base in its own axes [rad/s]; None for a fixed base.
        active: (N, F) bool, which feet stand on the floor.
    """

    source: str
    time: Array
    position: Array
    velocity: Array
    torque: Array
    quat_xyzw: Array | None
    angular_velocity: Array | None
    active: np.ndarray

    def windows(self, length: float) -> Array:
        """Successive windows, (W, 2) int: begin and end; evenly chosen if there are too many.

        Args:
            length: of each [s].

        Raises:
            LogError: the log has no window without a gap that begins with standing feet (floating base), or windows are
                shorter than two samples.
        """
        interval = float(np.median(np.diff(self.time)))
        if length < _FEWEST * interval:
            accepted = f"at least {_FEWEST * interval:.3g} s ({_FEWEST} sampling intervals)"
            raise LogError(self.source, "time", f"windows of {length:g} s", accepted)
        gaps = np.cumsum(np.diff(self.time, prepend=self.time[0]) > _LONGEST_GAP * interval)
        stands = np.full(len(self.time), self.angular_velocity is None) | self.active.any(axis=1)
        spans = list[tuple[int, int]]()
        begin = 0
        while begin < len(self.time) - 1:
            end = int(np.searchsorted(self.time, self.time[begin] + length - 0.5 * interval))
            if end >= len(self.time):
                break
            if gaps[end] != gaps[begin]:
                begin = int(np.searchsorted(gaps, gaps[begin] + 1))
            elif stands[begin]:
                spans.append((begin, end))
                begin = end
            else:
                begin += 1
        if not spans:
            accepted = "a shorter window, or a longer log" + ("" if stands.all() else " with standing feet")
            raise LogError(self.source, "time", f"has no window of {length:g} s without a gap", accepted)
        chosen = np.linspace(0, len(spans) - 1, min(len(spans), _MOST_WINDOWS)).round().astype(int)
        return np.array(spans)[chosen]


@dataclass(frozen=True)
class Model:
    """A robot to simulate: a URDF and, for its n joints, what a URDF cannot contain.

    Attributes:
        urdf: with inertia, damping and friction.
        joints: names of the n joints.
        armature: (n,), reflected rotor inertia [kg m^2 or kg].
        offset: (n,), subtracted from the joints' torques [N m or N].
        stiffness: (n,), of springs with rest position 0 [N m/rad or N/m].
        stribeck: (n,), static friction beyond that of the file [N m or N]; empty without.
        stribeck_velocity: of this friction [rad/s or m/s].
        constraints: between the joints.
    """

    urdf: Path
    joints: tuple[str, ...]
    armature: Array
    offset: Array
    stiffness: Array
    constraints: JointConstraints = field(default_factory=JointConstraints)
    stribeck: Array = field(default_factory=lambda: np.zeros(0))
    stribeck_velocity: float = np.inf


@dataclass(frozen=True)
class Drift:
    """Deviation of a simulated robot from the log, after T times in W windows.

    Attributes:
        time: (T,) since the begin of a window [s].
        joints: (W, T, n), simulated minus logged joint position [rad or m].
        tilt: (W, T), angle between the base orientations [rad]; None for a fixed base.
    """

    time: Array
    joints: Array
    tilt: Array | None

    def of_joints(self, columns: np.ndarray | slice = slice(None)) -> Array:
        """Root mean square over some joints, (W, T)."""
        return np.asarray(np.sqrt(np.mean(np.square(self.joints[..., columns]), axis=2)))


def replay_log(
    model: Model,
    log: ReplayedLog,
    feet: Sequence[Foot],
    windows: Array,
    times: Array,
    progress: Callable[[int], None] | None = None,
    gains: Array | None = None,
) -> Drift:
    """Drive a simulated robot with a log's torques, in windows that start at the log's state.

    Torques are linear between samples. With gains kp and kd the robot has a PD controller with the targets that
    produced the log's torques: the simulated torque is tau + kp (q - q_sim) + kd (v - v_sim), for the torque tau,
    position q and velocity v of the log.

    A floating base starts where the lowest of its standing feet touches a level floor, with the velocity that keeps
    them still.

    Args:
        model: the robot.
        log: the log.
        feet: in the order of `log.active`; not used for a fixed base.
        windows: (W, 2) int, from `ReplayedLog.windows`.
        times: (T,) since the begin of a window, for the drift [s], ascending.
        progress: called with the number of windows done.
        gains: kp [N m/rad or N/m] and kd [N m s/rad or N s/m] of each joint, (2, n); None for 0.

    Raises:
        UrdfError: MuJoCo does not accept the robot.
        InputError: an armature is negative.
    """
    kp, kd = np.zeros((2, len(model.joints))) if gains is None else gains
    robot = _Simulated(model, feet, log)
    robot.add_gains(kp, kd)
    driving = log.torque + kp * log.position + kd * log.velocity
    steps = np.arange(round(times[-1] * _PHYSICS_HZ)) / _PHYSICS_HZ
    joints = []
    tilts = []
    for begin, _ in windows:
        starts = float(log.time[begin])
        torque = _interpolated(starts + steps + 0.5 / _PHYSICS_HZ, log.time, driving) - model.offset
        position, quaternion = robot.run(begin, torque)
        since = np.append(0.0, steps + 1.0 / _PHYSICS_HZ)
        measured = _interpolated(starts + times, log.time, log.position)
        joints.append(_interpolated(times, since, position) - measured)
        if quaternion is not None and log.quat_xyzw is not None:
            simulated = Slerp(since, Rotation.from_quat(quaternion, scalar_first=True))(np.minimum(times, since[-1]))
            tilts.append((simulated.inv() * _orientation(log, starts + times)).magnitude())
        if progress is not None:
            progress(1)
    return Drift(times, np.array(joints), np.array(tilts) if tilts else None)


class _Simulated:
    """A robot in MuJoCo, put into states of a log."""

    def __init__(self, model: Model, feet: Sequence[Foot], log: ReplayedLog) -> None:
        for name, value in zip(model.joints, model.armature, strict=True):
            if value < 0.0:
                reason = f"{value:.3g} kg m^2; MuJoCo accepts no negative armature"
                raise InputError(model.urdf.parent, f"armature of {name}", reason, "estimator.name=consistent")
        self.log = log
        self.floating = log.angular_velocity is not None
        self.feet = feet if self.floating else ()
        self.model = compile_model(model.urdf, self.feet, _PHYSICS_HZ, self.floating, model.constraints)
        self.model.opt.gravity = GRAVITY_WORLD
        if not self.floating and log.quat_xyzw is not None:
            self.model.opt.gravity = Rotation.from_quat(log.quat_xyzw[0]).inv().apply(GRAVITY_WORLD)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in model.joints]
        self.at, self.rate = (np.array([int(getattr(x, key)[0]) for x in joints]) for key in ("qposadr", "dofadr"))
        self.model.dof_armature[self.rate] += model.armature
        self.model.jnt_stiffness[[joint.id for joint in joints]] = model.stiffness
        self.model.qpos_spring[self.at] = 0.0
        self.dry = self.model.dof_frictionloss[self.rate].copy()
        self.stribeck = model.stribeck
        self.stribeck_velocity = model.stribeck_velocity
        self.followers = Followers(self.model, model.constraints.mimics)

    def add_gains(self, kp: Array, kd: Array) -> None:
        """Pull joints to position 0 and velocity 0 by springs and dampers, (n,) each."""
        self.model.jnt_stiffness[self.model.dof_jntid[self.rate]] += kp
        self.model.dof_damping[self.rate] += kd
        fastest = float((self.model.dof_damping * self.model.dof_invweight0).max(initial=0.0))
        kinds = mujoco.mjtIntegrator
        self.model.opt.integrator = kinds.mjINT_RK4 if fastest < _PHYSICS_HZ else kinds.mjINT_IMPLICITFAST

    def run(self, begin: int, torque: Array) -> tuple[Array, Array | None]:
        """Positions of the joints (S + 1, n) and the base's quaternion w x y z, (S + 1, 4), from a sample on.

        Args:
            begin: index of the sample.
            torque: (S, n), of the joints at every step.
        """
        model = self.model
        data = self.data
        self._place(begin)
        if self.stribeck.any():
            path = np.array([data.qpos, *(self._step(forces) for forces in torque)])
            return path[:, self.at], path[:, 3:7] if self.floating else None
        force = np.zeros((1, len(torque), model.nv))
        force[0][:, self.rate] = torque
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.zeros(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, state, kind)
        spec = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        states, _ = rollout.rollout(model, data, state[None], force, control_spec=spec)
        position = np.vstack([state, states[0]])[:, 1 : 1 + model.nq]  # after the time
        return position[:, self.at], position[:, 3:7] if self.floating else None

    def _step(self, torque: Array) -> Array:
        """Positions (nq,) after a step with torques of the joints (n,), dry friction being that of their velocities."""
        data = self.data
        share = np.exp(-((data.qvel[self.rate] / self.stribeck_velocity) ** 2))
        self.model.dof_frictionloss[self.rate] = np.maximum(self.dry + self.stribeck * share, 0.0)
        data.qfrc_applied[self.rate] = torque
        mujoco.mj_step(self.model, data)
        return np.array(data.qpos)

    def _place(self, begin: int) -> None:
        """Put the robot into the state of a sample."""
        model = self.model
        data = self.data
        log = self.log
        mujoco.mj_resetData(model, data)
        data.qpos[self.at] = log.position[begin]
        data.qvel[self.rate] = log.velocity[begin]
        self.followers.place(data)
        if log.angular_velocity is not None and log.quat_xyzw is not None:
            data.qpos[3:7] = log.quat_xyzw[begin][[3, 0, 1, 2]]
            data.qvel[3:6] = log.angular_velocity[begin]
            mujoco.mj_fwdPosition(model, data)
            standing = [foot for foot, on in zip(self.feet, log.active[begin], strict=True) if on]
            low, still = zip(*(self._contact(foot) for foot in standing), strict=True)
            data.qpos[2] = -min(low)
            data.qvel[:3] = -np.mean(still, axis=0)

    def _contact(self, foot: Foot) -> tuple[float, Array]:
        """Height of a foot's lowest point [m], and the velocity (3,) of the material there [m/s]."""
        site = self.model.site(foot_site(foot)).id
        rotation = self.data.site_xmat[site].reshape(3, 3)
        origin = self.data.site_xpos[site]
        points = origin + np.array(foot.points) @ rotation.T
        lowest = int(np.argmin(points[:, 2] - foot.radii))
        J = np.zeros((3, self.model.nv))
        below = points[lowest] - [0.0, 0.0, foot.radii[lowest]]
        mujoco.mj_jac(self.model, self.data, J, None, below, int(self.model.site_bodyid[site]))
        return float(below[2]), J @ self.data.qvel


def _orientation(log: ReplayedLog, times: Array) -> Rotation:
    """Of the base at some times."""
    return Slerp(log.time, Rotation.from_quat(log.quat_xyzw))(np.minimum(times, log.time[-1]))


def _interpolated(times: Array, at: Array, values: Array) -> Array:
    """Columns of values, (N, k), linear between their times, (T, k)."""
    return np.stack([np.interp(times, at, column) for column in values.T], axis=1)
