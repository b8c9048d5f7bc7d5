"""Motions and noise-free forces made with Pinocchio, independent of everything under test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from torchid.logs import Log

PINOCCHIO_ORDER = [0, 1, 2, 3, 4, 5, 7, 6, 8, 9]  # Ixx, Ixy, Iyy, Ixz, Iyz, Izz: written out here on purpose


def robots_folder() -> Path:
    """Folder of the URDFs in the PyPI package example-robot-data."""
    for folder in Path(pin.__file__).resolve().parents:
        found = folder / "share" / "example-robot-data" / "robots"
        if found.is_dir():
            return found
    raise FileNotFoundError("the package example-robot-data is not installed")


ROBOTS = robots_folder()
SOLO12 = ROBOTS / "solo_description/robots/solo12.urdf"
G1 = ROBOTS / "g1_description/urdf/g1_29dof_rev_1_0.urdf"
ANYMAL = ROBOTS / "anymal_c_simple_description/urdf/anymal.urdf"
TALOS = ROBOTS / "talos_data/robots/talos_reduced.urdf"


@dataclass(frozen=True)
class Oracle:
    """A Pinocchio model addressed by the names of independent joints, in the order a test chooses."""

    model: pin.Model
    joint_names: tuple[str, ...]

    @classmethod
    def load(cls, urdf: Path, joint_names: Sequence[str], fixed_base: bool = False) -> Oracle:
        root = () if fixed_base else (pin.JointModelFreeFlyer(),)
        return cls(pin.buildModelFromUrdf(str(urdf), *root, mimic=True), tuple(joint_names))

    @property
    def base(self) -> int:
        return 6 if self.model.njoints > 1 and self.model.joints[1].shortname() == "JointModelFreeFlyer" else 0

    def _joint(self, name: str) -> pin.JointModel:
        return self.model.joints[self.model.getJointId(name)]

    def coordinates(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's q from (7 + n) or (n) coordinates."""
        full = pin.neutral(self.model)
        extra = 7 if self.base else 0
        full[:extra] = q[:extra]
        for name, value in zip(self.joint_names, q[extra:], strict=True):
            joint = self._joint(name)
            full[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
        return full

    @property
    def order(self) -> np.ndarray:
        """Places of our generalized velocities among Pinocchio's."""
        return np.array([*range(self.base), *(self._joint(name).idx_v for name in self.joint_names)], dtype=int)

    def velocities(self, v: np.ndarray) -> np.ndarray:
        full = np.zeros(self.model.nv)
        full[self.order] = v
        return full

    def forces(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Inverse dynamics in our order, one sample."""
        data = self.model.createData()
        state = self.coordinates(q), self.velocities(v), self.velocities(a)
        return pin.rnea(self.model, data, *state)[self.order]

    def jacobian(self, q: np.ndarray, frame: str) -> np.ndarray:
        """Frame Jacobian in the frame's own axes, in our order, one sample."""
        data = self.model.createData()
        index = self.model.getFrameId(frame, pin.FrameType.BODY)
        return pin.computeFrameJacobian(self.model, data, self.coordinates(q), index, pin.LOCAL)[:, self.order]

    def perturb(self, rng: np.random.Generator, share: float) -> None:
        """Multiply mass, centre of mass and inertia of every body by random factors; consistency is kept."""
        for index in range(self.model.njoints):
            inertia = self.model.inertias[index]
            if inertia.mass > 0.0:
                m, c, i = 1.0 + share * rng.uniform(-1.0, 1.0, 3)
                self.model.inertias[index] = pin.Inertia(m * inertia.mass, c * inertia.lever, i * m * inertia.inertia)


def random_states(rng: np.random.Generator, n: int, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unrelated random states (q, v, a) of a floating base: turned any way round, moving and accelerating."""
    quat = Rotation.random(samples, random_state=rng).as_quat()
    q = np.hstack([rng.normal(size=(samples, 3)), quat, rng.uniform(-1.5, 1.5, (samples, n))])
    return q, rng.normal(size=(samples, n + 6)), 3.0 * rng.normal(size=(samples, n + 6))


def make_log(
    oracle: Oracle,
    friction: np.ndarray,
    contacts: Sequence[tuple[str, int]],
    states: Sequence[Sequence[bool]],
    samples: int,
    rng: np.random.Generator,
    source: str = "synthetic.npz",
) -> Log:
    """A log whose forces close the dynamics exactly.

    Args:
        oracle: the true robot.
        friction: (n, 2), true Coulomb and viscous friction.
        contacts: frames with the number of components, 3 or 6, they can exert.
        states: contact states to cycle through; each must be able to carry any base wrench.
        samples: number of samples.
        rng: draws states and internal forces.
        source: name of the log.
    """
    n = len(oracle.joint_names)
    q, v, a = random_states(rng, n, samples)
    active = np.array([states[i % len(states)] for i in range(samples)], dtype=bool)
    torque, wrench = np.zeros((samples, n)), rng.normal(size=(samples, len(contacts), 6)) * 100.0
    for i in range(samples):
        needed = oracle.forces(q[i], v[i], a[i])
        needed[6:] += friction[:, 0] * np.sign(v[i, 6:]) + friction[:, 1] * v[i, 6:]
        used = [k for k in range(len(contacts)) if active[i, k]]
        J = np.vstack([oracle.jacobian(q[i], contacts[k][0])[: contacts[k][1]] for k in used])
        force = np.linalg.lstsq(J[:, :6].T, needed[:6], rcond=None)[0]
        null = np.linalg.svd(J[:, :6].T)[2][6:]
        force += 20.0 * null.T @ rng.normal(size=len(null))
        torque[i] = needed[6:] - J[:, 6:].T @ force
        start = 0
        for k in used:
            size = contacts[k][1]
            wrench[i, k, :size] = force[start : start + size]
            start += size
    rotation = Rotation.from_quat(q[:, 3:7])
    acceleration = a[:, :3] + np.cross(v[:, 3:6], v[:, :3])
    return Log(
        source=source,
        time=np.arange(samples) * 0.01,
        joint_names=oracle.joint_names,
        joint_position=q[:, 7:],
        joint_velocity=v[:, 6:],
        joint_acceleration=a[:, 6:],
        joint_torque=torque,
        base_quat_xyzw=q[:, 3:7],
        base_linear_acceleration_world=rotation.apply(acceleration),
        base_angular_velocity_base=v[:, 3:6],
        base_angular_acceleration_base=a[:, 3:6],
        contact_names=tuple(name for name, _ in contacts),
        contact_active=active,
        contact_wrench_local=wrench,
    )
