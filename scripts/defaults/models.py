"""Pinocchio's model of a URDF: forces of rigid bodies, apart from torchid's own regressor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from torchid.parameters import Array


@dataclass(frozen=True)
class Model:
    """A robot whose joints are those of a log, others held at zero.

    Attributes:
        model: Pinocchio's.
        joints: names in a log's order.
        floating: whether the base is free.
        index: of the joints' velocities.
    """

    model: Any
    joints: tuple[str, ...]
    floating: bool
    index: Array

    @classmethod
    def of(cls, urdf: Path, joints: Sequence[str], floating: bool) -> Model:
        """Read a URDF."""
        model = pin.buildModelFromUrdf(str(urdf), *([pin.JointModelFreeFlyer()] * floating))
        own = {"universe", "root_joint", *joints}
        held = [model.getJointId(name) for name in model.names if name not in own]
        model = pin.buildReducedModel(model, held, pin.neutral(model)) if held else model
        index = np.array([model.joints[model.getJointId(name)].idx_v for name in joints])
        return cls(model, tuple(joints), floating, index)

    @property
    def base(self) -> int:
        """Number of the base's velocities."""
        return 6 * self.floating

    def limits(self) -> tuple[Array, Array]:
        """Least and largest positions of the joints [rad], within two turns."""
        places = self.index + int(self.floating)
        lower, upper = self.model.lowerPositionLimit[places], self.model.upperPositionLimit[places]
        return np.maximum(lower, -np.pi), np.minimum(upper, np.pi)

    def configuration(self, joints: Array, pose: Array | None = None) -> Array:
        """Pinocchio's q (N, nq) of joint positions (N, n) and poses (N, 7): position, quaternion xyzw."""
        out = np.zeros((len(joints), self.model.nq))
        if self.floating:
            out[:, :7] = np.array([0.0, 0, 0, 0, 0, 0, 1.0]) if pose is None else pose
        out[:, self.index + int(self.floating)] = joints
        return out

    def rates(self, joints: Array, base: Array | None = None) -> Array:
        """Pinocchio's v or a (N, nv) of those of joints (N, n) and of the base (N, 6), along its axes."""
        out = np.zeros((len(joints), self.model.nv))
        if self.floating and base is not None:
            out[:, :6] = base
        out[:, self.index] = joints
        return out

    def forces(self, q: Array, v: Array, a: Array) -> Array:
        """Inverse dynamics (N, 6 + n) or (N, n): of the base, then of joints in the log's order."""
        data = self.model.createData()
        order = [*range(self.base), *self.index]
        return np.array([pin.rnea(self.model, data, *state)[order] for state in zip(q, v, a, strict=True)])

    def forces_of_contacts(self, q: Array, frames: Sequence[str], wrenches: Array) -> Array:
        """Generalized forces (N, nv) of wrenches (N, F, 6) along the world's axes at the frames' origins."""
        data, order = self.model.createData(), [*range(self.base), *self.index]
        ids = [self.model.getFrameId(name) for name in frames]
        out = np.zeros((len(q), self.model.nv))
        for i, state in enumerate(q):
            pin.computeJointJacobians(self.model, data, state)
            pin.updateFramePlacements(self.model, data)
            for k, frame in enumerate(ids):
                if wrenches[i, k].any():
                    J = pin.getFrameJacobian(self.model, data, frame, pin.LOCAL_WORLD_ALIGNED)
                    out[i] += J.T @ wrenches[i, k]
        return out[:, order]

    def masses(self) -> Array:
        """Masses of the bodies that move, with all that is fixed to them."""
        return np.array([one.mass for one in self.model.inertias[1:]])

    @property
    def bodies(self) -> list[str]:
        """Names of the joints that move these bodies, "base" for a free one."""
        return ["base" if name == "root_joint" else name for name in self.model.names[1:]]

    def inertias(self, q: Array) -> Array:
        """Mean of each joint's entry of the diagonal of the mass matrix (n,)."""
        data = self.model.createData()
        return np.mean([np.diag(pin.crba(self.model, data, state))[self.index] for state in q], axis=0)

    def limbs(self) -> list[list[int]]:
        """Joints of each part of the tree without branches, by number in the log's order."""
        of_joint = {self.model.getJointId(name): k for k, name in enumerate(self.joints)}
        children = np.bincount([self.model.parents[j] for j in of_joint], minlength=self.model.njoints)
        limb: dict[int, list[int]] = {}
        for j in sorted(of_joint):
            parent = self.model.parents[j]
            own = limb[parent] if parent in limb and children[parent] == 1 else []
            own.append(of_joint[j])
            limb[j] = own
        return list({id(x): x for x in limb.values()}.values())
