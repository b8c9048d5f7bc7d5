"""What the dynamics need to know of a motion, and how it follows from generalized coordinates."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

GRAVITY_WORLD = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class Motion:
    """Motion of B samples, batch first. K depends on nothing else: neither position nor heading matters.

    Attributes:
        joint_position, joint_velocity, joint_acceleration: (B, n) by the robot's `joint_names` [rad or m, /s, /s^2].
        base_angular_velocity, base_angular_acceleration: (B, 3) in the base frame [rad/s, rad/s^2].
        base_specific_force: (B, 3), acceleration of the base origin minus gravity, in the base frame [m/s^2]; what an
            ideal accelerometer there reads.
    """

    joint_position: Tensor
    joint_velocity: Tensor
    joint_acceleration: Tensor
    base_angular_velocity: Tensor
    base_angular_acceleration: Tensor
    base_specific_force: Tensor

    def __len__(self) -> int:
        return self.joint_position.shape[0]

    def __getitem__(self, index: slice | Tensor) -> Motion:
        """The same motion at fewer samples."""
        return Motion(*(getattr(self, f.name)[index] for f in fields(self)))

    def to(self, *args: object, **kwargs: object) -> Motion:
        """As `torch.Tensor.to`, for every part."""
        return Motion(*(getattr(self, f.name).to(*args, **kwargs) for f in fields(self)))


def motion_from_state(
    q: Tensor,
    v: Tensor,
    a: Tensor,
    n: int,
    fixed_base: bool = False,
    gravity: tuple[float, float, float] = GRAVITY_WORLD,
) -> Motion:
    """Motion from generalized coordinates in Pinocchio's free-flyer layout.

    Args:
        q: (B, 7 + n): base position in the world (3) [m], orientation as a unit quaternion x, y, z, w, joints;
            (B, n) for a fixed base.
        v: (B, nv): base linear and angular velocity in the base frame, then joints.
        a: (B, nv): d/dt of `v`.
        n: number of independent joints.
        fixed_base: whether the base is bolted, with its axes those of the world.
        gravity: (3,), in the world [m/s^2].

    Raises:
        ValueError: the shapes of `q`, `v` and `a` are others.
    """
    width_q, width_v = (n, n) if fixed_base else (n + 7, n + 6)
    if q.ndim != 2 or q.shape[1] != width_q or v.shape != (q.shape[0], width_v) or a.shape != v.shape:
        shapes = ", ".join(str(tuple(x.shape)) for x in (q, v, a))
        raise ValueError(f"q, v, a: found shapes {shapes}; accepted: (B, {width_q}), (B, {width_v}), (B, {width_v})")
    g_world = q.new_tensor(gravity)
    if fixed_base:
        zero = q.new_zeros(q.shape[0], 3)
        return Motion(q, v, a, zero, zero, zero - g_world)
    linear, angular = v[:, :3], v[:, 3:6]
    g_base = (rotation_matrix(q[:, 3:7]).mT @ g_world[:, None])[..., 0]
    specific_force = a[:, :3] + torch.linalg.cross(angular, linear) - g_base
    return Motion(q[:, 7:], v[:, 6:], a[:, 6:], angular, a[:, 3:6], specific_force)


def rotation_matrix(quat_xyzw: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4), scalar last."""
    x, y, z, w = quat_xyzw.unbind(-1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        ],
        dim=-1,
    ).unflatten(-1, (3, 3))
