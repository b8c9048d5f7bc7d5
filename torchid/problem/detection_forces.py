"""Forces of the ground on contacts, from joint torques and a robot's dynamics, and the parameters that fit them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from torchid import distributed
from torchid.logs.log import BoolArray, FloatArray
from torchid.parameters import FRICTION, GRAVITY, PER_BODY
from torchid.problem.compression import compress_parts
from torchid.problem.detection_motion import DetectionSamples
from torchid.problem.elimination import assemble
from torchid.problem.extras import ExtraTerms
from torchid.problem.linear import PRIOR_DEVIATION, LinearProblem
from torchid.problem.metrics import force_series
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.regressor import FrameJacobian
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

_DAMPING = 1e-3  # of actuators' terms, against the share that samples have of them
_LARGEST = 1.0, 100.0, 100.0  # armature [kg m^2] and friction [N m, N m s/rad] that nothing determines
_SIGN_WIDTH = 0.001  # rad/s, of friction's sign where none is stated: what rests has none
_FITTED = 4000  # samples, at least half of them, from which actuators' terms are worked out
_TOGETHER = 2048  # samples whose forces are solved for at once
_JOINT_SHARE, _BASE_SHARE = 0.1, 1.0  # errors of the URDF and of friction, of the largest torque's rms and the weight
_LEVER_M = 0.3  # arm of the base's moments for a force of the size of its errors
_FREE = 10.0  # standard deviation of a contact force that nothing determines, in weights


@dataclasses.dataclass(frozen=True)
class ForcesAlongNormals:
    """Forces along the ground's normal by the URDF's dynamics, with the armature and friction (m, 3) of a log's joints.

    Of all wrenches of all contacts, as if each could carry, those that balance measured joint torques, gravity and
    inertia best, weighted least squares over the joints' and the base's rows. A base of which neither pose nor IMU was
    recorded counts as still, and tilted as if all feet stood.

    Attributes:
        balance: of which they are worked out.
        actuators: armature, Coulomb and viscous friction.
        chosen: numbers (M,) of the evenly spaced samples of which these are.
        samples: those samples, in which all contacts stand.
        rotation: (M, 3, 3) of the base to the world.
        unexplained: (M,) [N], size of the force on the base that contact forces do not make up.
    """

    balance: _Balance
    actuators: FloatArray
    chosen: NDArray[np.intp]
    samples: Samples
    rotation: FloatArray
    unexplained: FloatArray

    @classmethod
    def of(
        cls, known: DetectionSamples, robot: Robot, contacts: Sequence[Contact], sign_width: float | None = None
    ) -> ForcesAlongNormals:
        """Of a log, with friction whose sign is so wide [rad/s or m/s]."""
        torque_rms = np.full(robot.n, np.nan)
        if known.samples.torque is not None:
            torque_rms = np.sqrt(np.square(known.samples.torque[:, : robot.n].numpy()).mean(axis=0))
        balance = _Balance.of(robot, contacts, torque_rms, sign_width)
        chosen = np.arange(0, len(known.log), -(-len(known.log) // _FITTED))
        samples, rotation = known.samples[torch.from_numpy(chosen)], known.rotation[chosen]
        found = balance.equations(samples, rotation)
        actuators = _fit_actuators(found)
        unexplained = balance.unexplained_force(found, actuators)
        return cls(balance, actuators, chosen, samples, rotation, unexplained)

    def with_parameters(self, nominal: FloatArray, armature: FloatArray) -> ForcesAlongNormals:
        """Those of the robot with other parameters (L, 12), and armatures (m,) of joints whose torque was measured."""
        balance = dataclasses.replace(self.balance, robot=dataclasses.replace(self.balance.robot, nominal=nominal))
        return dataclasses.replace(self, balance=balance, actuators=np.outer(armature, [1.0, 0.0, 0.0]))

    def of_samples(self, known: DetectionSamples) -> FloatArray:
        """Forces (K, C) [N] of all samples of a log."""
        chosen = [slice(start, start + _TOGETHER) for start in range(0, len(known.log), _TOGETHER)]
        equations = (self.balance.equations(known.samples[x], known.rotation[x]) for x in chosen)
        return np.concatenate([self.balance.normal_forces(found, self.actuators) for found in equations])


@dataclasses.dataclass(frozen=True)
class _Balance:
    """Of which rows, with which standard deviations (rows,) [N, N m], contact forces are worked out."""

    robot: Robot
    contacts: Sequence[Contact]
    builder: RowBuilder
    rows: BoolArray
    error: FloatArray
    weight: float

    @classmethod
    def of(
        cls, robot: Robot, contacts: Sequence[Contact], torque_rms: FloatArray, sign_width: float | None
    ) -> _Balance:
        """Of the base, and the joints whose torques were measured throughout: those with an rms (n,) [N m]."""
        measured = np.isfinite(torque_rms)
        rows = np.concatenate([np.ones(6, dtype=bool), measured])
        weight = GRAVITY * float(robot.nominal[:, 0].sum())
        of_joints = _JOINT_SHARE * float(torque_rms[measured].max(initial=0.0)) + 1e-6 * weight
        of_base = _BASE_SHARE * weight * np.array([1.0, 1.0, 1.0, _LEVER_M, _LEVER_M, _LEVER_M])
        error = np.concatenate([of_base, np.full(int(rows[6:].sum()), of_joints)])
        plain = [dataclasses.replace(contact, along_normal=False) for contact in contacts]
        sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
        sensors = dataclasses.replace(sensors, torque=np.append(measured, sensors.torque[robot.n :]))
        width = _SIGN_WIDTH if sign_width is None else sign_width
        builder = RowBuilder(robot, plain, sensors, ExtraTerms(armature=True, sign_width=width))
        return cls(robot, plain, builder, rows, error, weight)

    def equations(self, samples: Samples, rotation: FloatArray) -> _Equations:
        """Of some samples, with rotations (M, 3, 3) of the base to the world."""
        n = 6 + self.robot.n
        _, predicted = force_series(self.builder, samples, self.robot.nominal.flatten()[None])
        q, _, _ = samples.coordinates()
        missing = predicted[0, :, :n].copy()
        missing[:, 6:] -= np.zeros(1) if samples.torque is None else samples.torque[:, : self.robot.n].numpy()
        maps, normals = [], []
        for contact in self.contacts:
            normal = torch.tensor(contact.normal, dtype=torch.float64)
            jacobian = FrameJacobian(self.robot, contact.frame, contact.radius, contact.rolling_axis, contact.centre)
            J = jacobian(q, normal).numpy()
            maps.append(J[:, list(contact.components), :n][:, :, self.rows])
            in_base = rotation.swapaxes(1, 2) @ np.array(contact.normal)
            normals.append((J[:, :3, :3] @ in_base[..., None])[..., 0])  # which turns the base's axes into the frame's
        A = np.asarray(np.concatenate(maps, axis=1).swapaxes(1, 2) / self.error[:, None], dtype=np.float64)
        free = np.concatenate([_free(contact) for contact in self.contacts]) / (_FREE * self.weight)
        solver = np.linalg.solve(A.swapaxes(1, 2) @ A + np.diag(free**2), A.swapaxes(1, 2))
        velocity, acceleration = samples.joint_velocity, samples.joint_acceleration
        of_joints = [acceleration, self.builder.tree.coulomb_sign(velocity), velocity]
        terms = torch.stack(of_joints, dim=2).numpy()[:, self.rows[6:]]
        return _Equations(
            A,
            missing[:, self.rows] / self.error,
            np.asarray(solver, dtype=np.float64),
            terms / self.error[6:, None],
            normals,
        )

    def normal_forces(self, found: _Equations, actuators: FloatArray) -> FloatArray:
        """Normal forces (M, C) [N], with armature and friction (m, 3) of the joints whose torque was measured."""
        solved = (found.solver @ found.missing_with(actuators)[..., None])[..., 0]
        ends = np.cumsum([len(contact.components) for contact in self.contacts])[:-1]
        forces = [part[:, :3] for part in np.split(solved, ends, axis=1)]
        return np.stack([(f * u).sum(axis=1) for f, u in zip(forces, found.normals, strict=True)], axis=1)

    def unexplained_force(self, found: _Equations, actuators: FloatArray) -> FloatArray:
        """Size (M,) [N] of the force on the base that contact forces leave."""
        missing = found.missing_with(actuators)[..., None]
        left = (missing - found.maps @ (found.solver @ missing))[:, :3, 0] * self.error[:3]
        return np.asarray(np.linalg.norm(left, axis=1))


@dataclasses.dataclass(frozen=True)
class _Equations:
    """Whitened balances of M samples.

    Attributes:
        maps: of the k components of contact forces to rows, (M, rows, k).
        missing: what contact forces have to make up, (M, rows).
        solver: of that to the components, (M, k, rows).
        terms: acceleration, smoothed sign of the velocity and velocity by joint whose torque was measured, (M, m, 3).
        normals: of the ground in the frame of each contact, (M, 3).
    """

    maps: FloatArray
    missing: FloatArray
    solver: FloatArray
    terms: FloatArray
    normals: list[FloatArray]

    def missing_with(self, actuators: FloatArray) -> FloatArray:
        """What contact forces have to make up, (M, rows), with armature and friction (m, 3)."""
        out = self.missing.copy()
        out[:, 6:] += (self.terms * actuators).sum(axis=2)
        return out


def _fit_actuators(found: _Equations) -> FloatArray:
    """Armature, Coulomb and viscous friction (m, 3) by joint, from what no contact force can make up."""
    joints = found.terms.shape[1]
    inside = found.maps @ found.solver
    projector = (np.eye(inside.shape[1]) - inside)[:, 6:]
    matrix = np.einsum("njk,nja,nkb->jakb", projector[:, :, 6:], found.terms, found.terms, optimize=True)
    vector = -np.einsum("nj,nja->ja", (projector @ found.missing[..., None])[..., 0], found.terms)
    flat = matrix.reshape(3 * joints, 3 * joints) + np.diag(np.tile(np.square(_LARGEST), joints) ** -1.0)
    size = np.sqrt(np.diag(flat))
    damped = flat / size / size[:, None] + _DAMPING * np.eye(len(flat))
    fitted: FloatArray = (np.linalg.solve(damped, vector.reshape(-1) / size) / size).reshape(joints, 3)
    return np.maximum(fitted, 0.0)


def _free(contact: Contact) -> FloatArray:
    """Units of a contact's components over those of a force [1, 1/m]."""
    return np.array([1.0 if k < 3 else 1.0 / _LEVER_M for k in contact.components])


_PASSES = 3  # over the variance of what the parameters leave, which settles at once


def fitted_parameters(samples: Samples, builder: RowBuilder, robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Parameters (L, 12) of a robot, and armatures (m,) of its joints, neither friction nor armatures below zero.

    Args:
        samples: with joint torques and the contacts that stand.
        builder: of rows, whose extra parameters are armatures.
        robot: for the prior.
    """
    with distributed.apart():  # each process has logs of its own
        assembly = assemble(compress_parts([samples], builder), builder, robot)
    phi = most_probable(assembly.problem)
    armature = np.maximum(np.concatenate(assembly.extras_at(phi)), 0.0)
    phi = phi.reshape(-1, PER_BODY)
    phi[:, FRICTION] = np.maximum(phi[:, FRICTION], 0.0)
    return phi, armature


def most_probable(problem: LinearProblem) -> FloatArray:
    """Parameters (P,) that are most probable by data and nominal values, with the noise that the data themselves show.

    The prior is that of `PRIOR_DEVIATION`; MacKay, Bayesian Interpolation, 1992, with the prior's width known.
    """
    unit = problem.scale[problem.free] * PRIOR_DEVIATION
    A, b = problem.A[:, problem.free] * unit, problem.b - problem.A @ problem.nominal
    information, x = A.T @ A, np.zeros(len(unit))
    for _ in range(_PASSES):
        left = A @ x - b
        variance = problem.oversampling * (left @ left + problem.residual) / max(problem.rows, 1)
        x = np.linalg.lstsq(information + variance * np.eye(len(unit)), A.T @ b, rcond=None)[0]
    out = problem.nominal.copy()
    out[problem.free] += unit * x
    return out
