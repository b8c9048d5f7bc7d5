"""Motions and noise-free forces made with Pinocchio, independent of everything under test."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchid.errors import TorchidWarning
from torchid.logs import Log
from torchid.robot import Robot, load_robot

Array = NDArray[np.float64]

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
TALOS_FULL = ROBOTS / "talos_data/robots/talos_full_v2.urdf"
PANDA = ROBOTS / "panda_description/urdf/panda.urdf"
BAXTER = ROBOTS / "baxter_description/urdf/baxter.urdf"
TIAGO = ROBOTS / "tiago_description/robots/tiago_no_hand.urdf"
ROMEO = ROBOTS / "romeo_description/urdf/romeo.urdf"
TIAGO_PRO = ROBOTS / "tiago_pro_description/robots/tiago_pro.urdf"
UR5 = ROBOTS / "ur_description/urdf/ur5_robot.urdf"
DRONE = ROBOTS / "hector_description/robots/quadrotor_base.urdf"


def load(urdf: Path, base_link: str | None = None, fixed_base: bool = False, ft_joints: Sequence[str] = ()) -> Robot:
    """A robot whose known warnings (see test_robot_urdf.py) are not the matter of the test."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        return load_robot(urdf, base_link, fixed_base, ft_joints)


def joint_map(urdf: Path, joint_names: Sequence[str]) -> dict[str, tuple[Array, float]]:
    """Position of every moving joint as `row @ q + offset`, read from the XML; chains of mimic joints are followed."""
    root = ElementTree.parse(urdf).getroot()
    joints = {str(joint.get("name")): joint for joint in root.findall("joint") if joint.get("type") != "fixed"}

    def follow(name: str) -> tuple[Array, float]:
        mimic = joints[name].find("mimic")
        if mimic is None:
            return np.eye(len(joint_names))[list(joint_names).index(name)], 0.0
        row, offset = follow(str(mimic.get("joint")))
        ratio = float(mimic.get("multiplier", 1.0))
        return ratio * row, ratio * offset + float(mimic.get("offset", 0.0))

    return {name: follow(name) for name in joints}


def with_free_welds(urdf: Path, welds: Sequence[str]) -> str:
    """The URDF as text, with some fixed joints free to move in all six ways."""
    root = ElementTree.parse(urdf).getroot()
    for element in root.findall("joint"):
        if element.get("name") in welds:
            element.set("type", "floating")
    return ElementTree.tostring(root, encoding="unicode")


def transform(rotation: Array, position: Array) -> Array:
    """A pose, (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, position
    return T


class Oracle:
    """A Pinocchio model, with friction, addressed by the independent joints in the order a test chooses.

    Pinocchio knows every moving joint as independent; `expand` (its nv, our nv) ties the mimic joints to their masters,
    and forces follow by virtual work. `friction` (moving joints, 2), zero at first, is in Pinocchio's joint order.
    Welds with a force/torque sensor are free joints that stay at rest; their forces, in the child's frame, come last.
    """

    def __init__(
        self, urdf: Path, joint_names: Sequence[str], fixed_base: bool = False, ft_names: Sequence[str] = ()
    ) -> None:
        root = () if fixed_base else (pin.JointModelFreeFlyer(),)
        self.model = pin.buildModelFromXML(with_free_welds(urdf, ft_names), *root)
        self.data = self.model.createData()
        self.base = 0 if fixed_base else 6
        self.joint_names = tuple(joint_names)
        self.ft_names = tuple(ft_names)
        self.moving = [str(name) for name in self.model.names if name not in ft_names][1 if fixed_base else 2 :]
        by_name = joint_map(urdf, joint_names)
        self.ratios = np.array([by_name[name][0] for name in self.moving]).reshape(len(self.moving), len(joint_names))
        self.offsets = np.array([by_name[name][1] for name in self.moving])
        self.friction = np.zeros((len(self.moving), 2))
        nv = self.base + len(self.joint_names)
        self.expand = np.zeros((self.model.nv, nv + 6 * len(self.ft_names)))
        self.expand[: self.base, : self.base] = np.eye(self.base)
        self.expand[[self._joint(name).idx_v for name in self.moving], self.base : nv] = self.ratios
        for name, column in zip(self.ft_names, range(nv, self.expand.shape[1], 6), strict=True):
            place = self._joint(name).idx_v
            self.expand[place : place + 6, column : column + 6] = np.eye(6)

    @classmethod
    def of(cls, robot: Robot) -> Oracle:
        """Of the URDF a robot was read from, with the robot's joint order."""
        return cls(robot.path, robot.joint_names, robot.fixed_base, robot.ft_names)

    def _joint(self, name: str) -> Any:
        return self.model.joints[self.model.getJointId(name)]

    def coordinates(self, q: Array) -> Array:
        """Pinocchio's q from (7 + n) or (n) coordinates, one sample."""
        full = pin.neutral(self.model)
        extra = 7 if self.base else 0
        full[:extra] = q[:extra]
        for name, value in zip(self.moving, self.ratios @ q[extra:] + self.offsets, strict=True):
            joint = self._joint(name)
            full[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else (np.cos(value), np.sin(value))
        return full

    def _state(self, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        moving = self.expand[:, : len(v)]
        return self.coordinates(q), moving @ v, moving @ a

    def frictionless_forces(self, q: Array, v: Array, a: Array) -> Array:
        """Inverse dynamics, (B, nv + 6 F), of states (B, ...)."""
        rows = [pin.rnea(self.model, self.data, *self._state(*state)) for state in zip(q, v, a, strict=True)]
        return np.array(rows) @ self.expand

    def mass_matrix(self, q: Array) -> Array:
        """Joint-space inertia, (nv + 6 F, nv + 6 F), at one sample's coordinates."""
        return self.expand.T @ pin.crba(self.model, self.data, self.coordinates(q)) @ self.expand

    def friction_torques(self, v: Array) -> Array:
        """Torque that friction takes from the actuators, (B, n)."""
        velocity = v[:, self.base :] @ self.ratios.T
        return (self.friction[:, 0] * np.sign(velocity) + self.friction[:, 1] * velocity) @ self.ratios

    def forces(self, q: Array, v: Array, a: Array) -> Array:
        """Inverse dynamics with friction, (B, nv + 6 F), of states (B, ...)."""
        needed = self.frictionless_forces(q, v, a)
        needed[:, self.base : v.shape[1]] += self.friction_torques(v)
        return needed

    def regressor(self, robot: Robot, q: Array, v: Array, a: Array) -> Array:
        """Columns (B, nv + 6 F, L, 10) of the ten inertial numbers by the robot's bodies, in this project's order."""
        out = np.zeros((len(q), self.expand.shape[1], len(robot.bodies), 10))
        places = self._places(robot)
        for sample, state in enumerate(zip(q, v, a, strict=True)):
            columns = pin.computeJointTorqueRegressor(self.model, self.data, *self._state(*state))
            by_body = (self.expand.T @ columns).reshape(self.expand.shape[1], columns.shape[1] // 10, 10)
            for body, place in places:
                out[sample, :, body, PINOCCHIO_ORDER] = by_body[:, place - 1].T
        return out

    def friction_regressor(self, robot: Robot, v: Array) -> Array:
        """Columns (B, nv + 6 F, L, 2) of Coulomb and viscous friction by the robot's bodies."""
        out = np.zeros((len(v), self.expand.shape[1], len(robot.bodies), 2))
        names = [body.joint.name if body.joint else "" for body in robot.bodies]
        for name, ratios in zip(self.moving, self.ratios, strict=True):
            velocity = v[:, self.base :] @ ratios
            column = np.stack([np.sign(velocity), velocity], axis=1)
            out[:, self.base : v.shape[1], names.index(name)] = ratios[:, None] * column[:, None]
        return out

    def _places(self, robot: Robot) -> list[tuple[int, int]]:
        """Pairs of our body and Pinocchio's; the bolted base has none."""
        return [
            (index, 1 if body.joint is None else self.model.getJointId(body.joint.name))
            for index, body in enumerate(robot.bodies)
            if body.joint is not None or self.base
        ]

    def inertial_parameters(self, robot: Robot) -> Array:
        """Ten inertial numbers of every body, (L, 10); of a bolted base, zero."""
        phi = np.zeros((len(robot.bodies), 10))
        for body, place in self._places(robot):
            phi[body, PINOCCHIO_ORDER] = self.model.inertias[place].toDynamicParameters()
        return phi

    def jacobian(self, q: Array, frame: str) -> Array:
        """Frame Jacobians in the frame's own axes, (B, 6, nv + 6 F)."""
        index = self.model.getFrameId(frame, pin.FrameType.BODY)
        state = [self.coordinates(sample) for sample in q]
        rows = [pin.computeFrameJacobian(self.model, self.data, full, index, pin.LOCAL) for full in state]
        return np.array(rows) @ self.expand

    def pose(self, q: Array, frame: str) -> tuple[Array, Array]:
        """World rotations (B, 3, 3) and positions (B, 3) of a frame."""
        index = self.model.getFrameId(frame, pin.FrameType.BODY)
        rotations, positions = [], []
        for sample in q:
            pin.framesForwardKinematics(self.model, self.data, self.coordinates(sample))
            rotations.append(self.data.oMf[index].rotation.copy())
            positions.append(self.data.oMf[index].translation.copy())
        return np.array(rotations), np.array(positions)

    def power(self, q: Array, v: Array, a: Array) -> Array:
        """Rate of change of kinetic plus potential energy, (B,) [W], without looking at any force.

        d/dt (v^T M v / 2) along a motion is v^T M a + v^T dM/dt v / 2; the last term and the potential's come from
        differences over 1e-4 s.
        """
        step, rates = 1e-4, []
        for state in zip(q, v, a, strict=True):
            full, velocity, acceleration = self._state(*state)
            energies = []
            for dt in (-2.0 * step, -step, step, 2.0 * step):
                at = pin.integrate(self.model, full, dt * velocity + 0.5 * dt * dt * acceleration)
                energies.append(pin.computeMechanicalEnergy(self.model, self.data, at, velocity + dt * acceleration))
            rates.append((energies[0] - 8.0 * energies[1] + 8.0 * energies[2] - energies[3]) / (12.0 * step))
        return np.array(rates)

    def perturb(self, rng: np.random.Generator, share: float) -> None:
        """Change mass, centre of mass and inertia of every body by up to `share`, turn the inertia, add friction.

        Positive masses and principal inertias that obey the triangle inequality stay so.
        """
        for index in range(self.model.njoints):
            inertia = self.model.inertias[index]
            if inertia.mass > 0.0:
                m, i = 1.0 + share * rng.uniform(-1.0, 1.0, 2)
                lever = inertia.lever * (1.0 + share * rng.uniform(-1.0, 1.0, 3))
                turn = Rotation.from_rotvec(share * rng.uniform(-1.0, 1.0, 3)).as_matrix()
                self.model.inertias[index] = pin.Inertia(
                    m * inertia.mass, lever, i * m * turn @ inertia.inertia @ turn.T
                )
        self.friction = rng.uniform(0.2, 1.5, self.friction.shape)


def random_states(
    rng: np.random.Generator, n: int, samples: int, fixed_base: bool = False, tilt: float | None = None
) -> tuple[Array, Array, Array]:
    """Unrelated random states (q, v, a), everything moving and accelerating.

    The base is turned any way round, or any way about the vertical and by so much about other axes, about [rad].
    """
    joints = rng.uniform(-1.5, 1.5, (samples, n))
    nv = n + (0 if fixed_base else 6)
    v, a = rng.normal(size=(samples, nv)), 3.0 * rng.normal(size=(samples, nv))
    if fixed_base:
        return joints, v, a
    if tilt is None:
        quat = Rotation.random(samples, random_state=rng).as_quat()
    else:
        turned = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (samples, 1)))
        quat = (turned * Rotation.from_rotvec(tilt * rng.normal(size=(samples, 3)) * [1.0, 1.0, 0.0])).as_quat()
    return np.hstack([rng.normal(size=(samples, 3)), quat, joints]), v, a


def _close_the_dynamics(
    oracle: Oracle, q: Array, v: Array, a: Array, contacts: Sequence[tuple[str, Sequence[int]]],
    active: NDArray[np.bool_], rng: np.random.Generator,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Accelerations (B, nv), torques (B, n + 6 F) and wrenches (B, C, 6) that obey the dynamics, with random forces.

    Contacts carry of the base wrench what they can; the base accelerates by the rest, as in flight. A bolted base
    carries what it must, so that its contacts push at random.
    """
    base, a = oracle.base, a.copy()
    J = np.zeros((len(q), len(contacts), 6, oracle.expand.shape[1]))
    for k, (frame, _) in enumerate(contacts):
        J[:, k] = oracle.jacobian(q, frame)
    wrench = 100.0 * rng.normal(size=(len(q), len(contacts), 6))  # noise wherever nothing can push
    needed = oracle.forces(q, v, a)
    through_contacts = np.zeros_like(needed)
    for i in range(len(q)):
        rows = [(k, component) for k, (_, pushed) in enumerate(contacts) if active[i, k] for component in pushed]
        J_C = np.array([J[i, k, component] for k, component in rows]).reshape(-1, needed.shape[1])
        force = 20.0 * rng.normal(size=len(rows))
        if base:
            inverse = np.linalg.pinv(J_C[:, :6].T, rcond=0.01)
            force += inverse @ (needed[i, :6] - J_C[:, :6].T @ force)
            left = needed[i, :6] - J_C[:, :6].T @ force
            a[i, :6] -= np.linalg.solve(oracle.mass_matrix(q[i])[:6, :6], left)
        through_contacts[i] = J_C.T @ force
        for (k, component), value in zip(rows, force, strict=True):
            wrench[i, k, component] = value
    torque = (oracle.forces(q, v, a) - through_contacts)[:, base:]
    return a, torque, wrench


def make_log(
    oracle: Oracle,
    contacts: Sequence[tuple[str, int | Sequence[int]]],
    states: Sequence[Sequence[bool]],
    samples: int,
    rng: np.random.Generator,
    source: str = "synthetic.npz",
    tilt: float | None = None,
) -> Log:
    """A log of unrelated random states whose forces close the dynamics exactly.

    Args:
        oracle: the true robot.
        contacts: frames with the components of a wrench that they can exert, or the number of the first of these.
        states: contact states to cycle through, flight included.
        samples: number of samples.
        rng: draws states and internal forces.
        source: name of the log.
        tilt: of the base, as `random_states` has it.
    """
    q, v, a = random_states(rng, len(oracle.joint_names), samples, not oracle.base, tilt)
    active = np.array([states[i % len(states)] for i in range(samples)], dtype=bool).reshape(samples, len(contacts))
    pushing = [(name, range(size) if isinstance(size, int) else size) for name, size in contacts]
    a, torque, wrench = _close_the_dynamics(oracle, q, v, a, pushing, active, rng)
    extra, n = 7 if oracle.base else 0, len(oracle.joint_names)
    base: dict[str, Any] = {}
    if oracle.base:
        rotation = Rotation.from_quat(q[:, 3:7])
        base = {
            "base_quat_xyzw": q[:, 3:7],
            "base_linear_acceleration_world": rotation.apply(a[:, :3] + np.cross(v[:, 3:6], v[:, :3])),
            "base_angular_velocity_base": v[:, 3:6],
            "base_angular_acceleration_base": a[:, 3:6],
        }
    return Log(
        source=source,
        time=np.arange(samples) * 0.01,
        joint_names=oracle.joint_names,
        joint_position=q[:, extra:],
        joint_velocity=v[:, oracle.base :],
        joint_acceleration=a[:, oracle.base :],
        joint_torque=torque[:, :n],
        contact_names=tuple(name for name, _ in contacts),
        contact_active=active,
        contact_wrench_local=wrench,
        ft_names=oracle.ft_names,
        ft_wrench=torque[:, n:].reshape(samples, -1, 6) if oracle.ft_names else None,
        **base,
    )
