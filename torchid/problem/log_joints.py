"""A log's joints in the robot's order: torques, passive and welded joints, and joints that loops determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.errors import LogError, UnknownNameError, join_names, warn
from torchid.logs import Log
from torchid.logs.log import SHAPES, FloatArray
from torchid.logs.time_range import log_title
from torchid.parameters import Array
from torchid.regressor.loops import LoopClosures
from torchid.robot import Loop, Robot
from torchid.robot.tree import LOOPS_FIELD
from torchid.sensing import SensorSet

_LISTED = 6
_NO_TORQUE = 1e-9  # N m or N: rounding in a simulator's torque of a joint without a motor


def joint_order(log: Log, robot: Robot) -> list[int]:
    """Columns of a log's joints in the robot's order; InputError if a joint is missing or unknown."""
    known = {body.joint.name for body in robot.bodies if body.joint is not None} | robot.welded.keys()
    for name in log.joint_names:
        if name not in known:
            raise UnknownNameError(log.source, "joint_names", name, robot.joint_names)
    lacking = [name for name in robot.joint_names if name not in log.joint_names]
    if lacking:
        reason = f"missing joints of {robot.path.name}: {join_names(lacking, _LISTED)}"
        listed = ", ".join(lacking) if len(lacking) <= _LISTED else f"{lacking[0]}, ..."
        accepted = f"all moving joints, or robot.weld: [{listed}] for joints that do not move"
        accepted += "; a joint of a loop may be missing if the others determine it" if robot.loops else ""
        raise LogError(log.source, "joint_names", reason, accepted)
    return [log.joint_names.index(name) for name in robot.joint_names]


def recorded_torques(log: Log, robot: Robot, order: list[int]) -> Tensor | None:
    """Joint torques and limb sensor wrenches, (N, n + 6 F); None if there are neither."""
    if log.joint_torque is None and not (robot.ft_names and log.ft_wrench is not None) and not robot.passive:
        return None
    not_recorded = np.full((len(log), robot.n), np.nan)
    torque = not_recorded if log.joint_torque is None else columns_in_order(log.joint_torque, order)
    parts = [_with_passive(torque, log, robot) if robot.passive else torque]
    for name in robot.ft_names:
        if log.ft_wrench is None or name not in log.ft_names:
            parts.append(np.full((len(log), 6), np.nan))
        else:
            parts.append(log.ft_wrench[:, log.ft_names.index(name)])
    return torch.from_numpy(parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1))


def _with_passive(torque: FloatArray, log: Log, robot: Robot) -> FloatArray:
    """Joint torques (N, n) with zeros for joints without a motor; LogError if one was recorded with a torque."""
    passive = robot.is_passive[: robot.n]
    size = np.nanmax(np.abs(torque), axis=0, initial=0.0, where=np.isfinite(torque))
    driven = passive & (size > _NO_TORQUE)
    if driven.any():
        names = [robot.joint_names[joint] for joint in np.flatnonzero(driven)]
        reason = f"up to {size[driven].max():.3g} N m at joints without a motor: {join_names(names, _LISTED)}"
        others = ", ".join(name for name in robot.passive if name not in names)
        raise LogError(log.source, "joint_torque", reason, f"0 or NaN there, or robot.passive: [{others}]")
    return np.where(passive, 0.0, torque)


def require_limb_sensors(log: Log, robot: Robot, required: SensorSet) -> None:
    """Raise LogError if the log lacks a required limb force/torque sensor."""
    needed = required.torque[robot.n :].reshape(-1, 6)
    names = [name for name, axes in zip(robot.ft_names, needed, strict=True) if axes.any()]
    if names and log.ft_wrench is None:
        raise LogError(log.source, "ft_wrench", "missing", "the field, or no sensors.ft_sensors")
    if missing := [name for name in names if name not in log.ft_names]:
        accepted = f"in sensors.ft_sensors only names that the log has: {', '.join(log.ft_names)}"
        raise LogError(log.source, "ft_names", f"missing sensors: {', '.join(missing)}", accepted)


def columns_in_order(x: np.ndarray, order: list[int]) -> np.ndarray:
    """Columns (N, n) of an array (N, columns); no copy if the order does not change."""
    return x if order == list(range(x.shape[1])) else x[:, order]


_TOLERANCE = {"prismatic": (0.005, "m")}  # a joint that moves less is welded with small error
_TOLERANCE_OF_OTHERS = (0.05, "rad")


def without_welded_joints(log: Log, robot: Robot | None) -> Log:
    """Remove the columns of welded joints. Warns TorchidWarning if a joint is not at its welded position."""
    if robot is None or robot.welded.keys().isdisjoint(log.joint_names):
        return log
    kept = [column for column, name in enumerate(log.joint_names) if name not in robot.welded]
    _warn_of_moving_welds(log, robot)
    arrays: dict[str, Any] = {
        name: array[:, kept] for name, array in log.arrays().items() if SHAPES[name] == ("N", "n")
    }
    return replace(log, joint_names=tuple(log.joint_names[column] for column in kept), **arrays)


def _warn_of_moving_welds(log: Log, robot: Robot) -> None:
    """Warn, once, if joints of a log are not at their welded positions."""
    held = np.array([robot.welded.get(name, np.nan) for name in log.joint_names])
    distances = np.nan_to_num(np.abs(log.joint_position - held)).max(axis=0, initial=0.0)
    far = []
    for name, distance in zip(log.joint_names, distances, strict=True):
        limit, unit = _TOLERANCE.get(robot.kind_of_welded.get(name, ""), _TOLERANCE_OF_OTHERS)
        if distance > limit:
            far.append(f"'{name}' is up to {distance:.2g} {unit} away from its welded {robot.welded[name]:g} {unit}")
    if far:
        warn(f"{log_title(log.source)}: joint {'; '.join(far)}. robot.weld is an approximation here")


_CHUNK = 4096  # samples
_CHECK_LOOP = "check encoder offsets and the loop's frames"


@dataclass(frozen=True)
class LoopGap:
    """Distance [m] and angle [rad] between a loop's frames over a log, rms and largest; a point loop has angle 0."""

    loop: Loop
    rms: float
    largest: float
    rms_angle: float
    largest_angle: float

    @property
    def is_open(self) -> bool:
        """Whether the rms gap exceeds the loop's `max_gap` or `max_angle`."""
        return self.rms > self.loop.max_gap or self.rms_angle > self.loop.max_angle

    @property
    def accepted(self) -> str:
        """The accepted gap, as text."""
        bound = f"up to {1e3 * self.loop.max_gap:.3g} mm"
        return bound if self.loop.kind != "weld" else f"{bound} and {np.degrees(self.loop.max_angle):.3g} deg"

    def __str__(self) -> str:
        text = f"{1e3 * self.rms:.3g} mm rms, {1e3 * self.largest:.3g} mm at most"
        if self.loop.kind != "weld":
            return text
        return f"{text}; {np.degrees(self.rms_angle):.3g} deg rms, {np.degrees(self.largest_angle):.3g} deg at most"


def loop_gaps(robot: Robot, joint_position: torch.Tensor) -> list[LoopGap]:
    """The gap of each loop of a robot at joint positions (N, n) [rad or m]."""
    if not robot.loops or not len(joint_position):
        return []
    closures = LoopClosures(robot)
    parts = list[Array]()
    for start in range(0, len(joint_position), _CHUNK):
        gaps = closures.gaps(joint_position[start : start + _CHUNK].double())
        parts.append(np.array([[x.numpy() for x in gap] for gap in gaps]))
    sizes = np.concatenate(parts, axis=2)  # (loops, 2, N)
    rms = np.sqrt(np.square(sizes).mean(axis=2))
    largest = sizes.max(axis=2)
    return [
        LoopGap(loop, float(r[0]), float(x[0]), float(r[1]), float(x[1]))
        for loop, r, x in zip(robot.loops, rms, largest, strict=True)
    ]


def require_closed_loops(source: str, joint_position: torch.Tensor, robot: Robot) -> None:
    """Raise LogError if the frames of a loop are apart.

    Args:
        source: the log's file.
        joint_position: (N, n) [rad or m].
        robot: with its loops.
    """
    for number, gap in enumerate(loop_gaps(robot, joint_position)):
        if gap.is_open:
            reason = f"{gap.loop.label} are apart by {gap}"
            accepted = f"{gap.accepted} rms (the loop's max_gap, max_angle); {_CHECK_LOOP}"
            raise LogError(source, f"{LOOPS_FIELD}[{number}]", reason, accepted)


_FAR = 0.1  # rad or m of joint motion between samples that are solved from the assembled posture
_PATH = 20  # steps on the way from there
_DETERMINED = 1e-6  # smallest over largest singular value of the loops' Jacobian for the missing joints


def with_loop_joints(log: Log, robot: Robot | None) -> Log:
    """Add joints of closed loops that the log lacks, if the other joints determine them.

    Positions close the loops, on a path from the closed posture nearest to joint positions of 0. Velocities and
    accelerations, if the log has them, follow from the differentiated constraints. Torques are NaN.

    Raises:
        LogError: the loops do not determine the missing joints, or do not close.
    """
    if robot is None or not robot.loops:
        return log
    closures = LoopClosures(robot)
    missing = [k for k, name in enumerate(robot.joint_names) if name not in log.joint_names]
    if not missing or not set(missing) <= set(closures.dofs):
        return log
    known = [k for k in range(robot.n) if k not in missing]
    order = [log.joint_names.index(robot.joint_names[k]) for k in known]
    joints = _Joints(log, robot, closures, known, missing)
    velocity, acceleration = (None if x is None else x[:, order] for x in (log.joint_velocity, log.joint_acceleration))
    added = joints.motion(log.joint_position[:, order], velocity, acceleration)
    arrays: dict[str, Any] = {}
    for name, array in log.arrays().items():
        if SHAPES[name] == ("N", "n"):
            new = added.get(name, np.full((len(log), len(missing)), np.nan))
            arrays[name] = np.concatenate([array, new], axis=1)
    return replace(log, joint_names=(*log.joint_names, *(robot.joint_names[k] for k in missing)), **arrays)


@dataclass(frozen=True)
class _Joints:
    """Known joints of a log, and missing joints that follow from them, in the robot's order."""

    log: Log
    robot: Robot
    closures: LoopClosures
    known: list[int]
    missing: list[int]

    def motion(
        self, position: FloatArray, velocity: FloatArray | None, acceleration: FloatArray | None
    ) -> dict[str, FloatArray]:
        """Motion (N, missing) by field, from that of the known joints (N, known)."""
        q = torch.full((len(position), self.robot.n), torch.nan, dtype=torch.float64)
        q[:, self.known] = torch.from_numpy(position)
        finite = torch.isfinite(q[:, self.known]).all(1)
        if finite.any():
            q[finite] = self._positions(q[finite])
        out = {"joint_position": q[:, self.missing].numpy()}
        if velocity is None:
            return out
        v = self._derivative(q, velocity, None)
        out["joint_velocity"] = v[:, self.missing].numpy()
        if acceleration is not None:
            out["joint_acceleration"] = self._derivative(q, acceleration, v)[:, self.missing].numpy()
        return out

    def _positions(self, q: Tensor) -> Tensor:
        """Positions (N, n) with the missing joints where the loops close."""
        known = q[:, self.known].numpy()
        way = np.cumsum(np.abs(np.diff(known, axis=0, prepend=known[:1])).max(axis=1, initial=0.0))
        at, last = np.unique(way // _FAR, return_index=True, return_inverse=True)[1:]
        nodes = self._from_assembled(q[at])
        self._require_determined(nodes)
        q = q.clone()
        q[:, self.missing] = nodes[last][:, self.missing]
        q = torch.cat([self.closures.fitted(part, self.missing) for part in q.split(_CHUNK)])
        is_open = self._is_open(q)
        if is_open.any():
            q[is_open] = self._from_assembled(q[is_open])
        self._require_closed(q)
        return q

    def _from_assembled(self, q: Tensor) -> Tensor:
        """The same, step by step from the posture nearest to joint positions of 0."""
        assembled, _ = self.closures.closed(torch.zeros(1, self.robot.n, dtype=torch.float64))
        out = assembled.repeat(len(q), 1)
        way = (q - assembled)[:, self.known] / _PATH
        for _ in range(_PATH):
            out[:, self.known] += way
            out = self.closures.fitted(out, self.missing)
        out[:, self.known] = q[:, self.known]
        return out

    def _is_open(self, q: Tensor) -> Tensor:
        """Samples (N,) in which a loop is open by more than it accepts."""
        pairs = zip(self.closures.gaps(q), self.robot.loops, strict=True)
        each = [(gap > loop.max_gap) | (angle > loop.max_angle) for (gap, angle), loop in pairs]
        return torch.stack(each).any(0)

    def _derivative(self, q: Tensor, known: FloatArray, velocity: Tensor | None) -> Tensor:
        """Velocities (N, n) from those of the known joints, or accelerations if velocities are given."""
        out = q.new_zeros(len(q), self.robot.n)
        out[:, self.known] = torch.from_numpy(known)
        for start in range(0, len(q), _CHUNK):
            rows = slice(start, start + _CHUNK)
            J = self.closures.jacobian(q[rows])[..., : self.robot.n]
            gap_rate = (J @ out[rows, :, None])[..., 0]
            if velocity is not None:
                gap_rate = gap_rate + self.closures.drift(q[rows], velocity[rows])
            out[rows, self.missing] -= (torch.linalg.pinv(J[..., self.missing]) @ gap_rate[..., None])[..., 0]
        return out

    def _require_determined(self, q: Tensor) -> None:
        J = self.closures.jacobian(q)[..., self.missing]
        values = torch.linalg.svdvals(J)
        if J.shape[1] < len(self.missing) or bool((values[:, -1] <= _DETERMINED * values[:, 0]).all()):
            reason = f"the loops of {self.robot.path.name} do not determine missing joints {self._names(self.missing)}"
            raise LogError(self.log.source, "joint_names", reason, "more joints of these loops in the log")

    def _require_closed(self, q: Tensor) -> None:
        for number, gap in enumerate(loop_gaps(self.robot, q)) if self._is_open(q).any() else ():
            if gap.largest > gap.loop.max_gap or gap.largest_angle > gap.loop.max_angle:
                reason = f"{gap.loop.label} are apart by {gap} at every position of {self._names(self.missing)}"
                accepted = f"{gap.accepted} in every sample; {_CHECK_LOOP}"
                raise LogError(self.log.source, f"{LOOPS_FIELD}[{number}]", reason, accepted)

    def _names(self, joints: Sequence[int]) -> str:
        return join_names([self.robot.joint_names[k] for k in joints])
