"""Rows against Pinocchio: every kind of robot, with every kind of sensor set, recorded in every convention.

A row is W^T [K | f], where no unmeasured force may enter and the noise must be white. K, the contacts' Jacobians and
forces that obey the dynamics come from Pinocchio, for robots that differ from their URDFs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from motions import value
from recordings import GRAVITY, in_world, on_plates, states_of, with_imu
from rolling_oracle import RollingOracle, unit
from scipy.spatial.transform import Rotation
from synthetic import ANYMAL, G1, PANDA, SOLO12, TALOS_FULL, TIAGO, Array, Oracle, load, make_log
from thinned import each_once
from true_robots import true_parameters
from welded import CONTACTS, SENSORS, machine

from torchid.logs import Log
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.problem.chunks import chunks_by_state
from torchid.problem.metrics import force_series
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

BASE = np.array([0.7, 0.9, 1.1, 0.05, 0.06, 0.08])  # standard deviations along the axes of the levelled base
NOISE = SensorNoise(0.3, 1.5, 0.1, tuple(BASE[:3].tolist()), tuple(BASE[3:].tolist()), ft_force=0.9, ft_moment=0.02)
JOINT, WRENCH, LIMB = 0.3, *(np.repeat(pair, 3) for pair in ((1.5, 0.1), (0.9, 0.02)))  # of NOISE once more
STUDY = [pytest.mark.study]
EXACT = 1e-11  # of the largest number; 1e-12 measured

LEGS = ("LF", "RF", "LH", "RH")
SOLES = tuple(Contact(f"{side}_ankle_roll_link", "flat") for side in ("left", "right"))
ASKEW = (0.3, -0.2, 0.8)
"""A normal of the ground, not of unit length."""


def rolling(*radii: tuple[str, float]) -> list[Contact]:
    """Spheres about frames on ground that is not level."""
    return [Contact(frame, "point", radius=radius, normal=ASKEW) for frame, radius in radii]


def scalar(contacts: Sequence[Contact], *frames: str) -> list[Contact]:
    """The contacts, those at some frames, by default all, with a sensor of the force along the normal alone."""
    return [replace(x, along_normal=x.frame in frames or not frames) for x in contacts]


MACHINES: dict[str, tuple[Path | None, bool, Sequence[Contact]]] = {
    "quadruped": (ANYMAL, False, [Contact(f"{leg}_FOOT", "point") for leg in ("LF", "RF", "LH", "RH")]),
    "humanoid": (G1, False, SOLES),
    "humanoid with mimic fingers": (
        TALOS_FULL, False, [Contact("left_sole_link", "flat"), Contact("right_sole_link", "line")]
    ),
    "in flight": (SOLO12, False, []),
    "skew tree with sensors in limbs": (None, False, CONTACTS),
    "bolted arm": (PANDA, True, [Contact("panda_rightfinger", "point"), Contact("panda_hand", "line", "x")]),
    "bolted skew tree with sensors in limbs": (None, True, CONTACTS),
    "balls on recorded ground": (ANYMAL, False, rolling(*((f"{leg}_FOOT", 0.04) for leg in ("LF", "RF", "LH", "RH")))),
    "balls and rockers below sensors in limbs": (
        None, False, [Contact("sole", "line", "x", 0.3, ASKEW), Contact("thigh", "point", radius=0.1),
                      Contact("fin", "line", "z", 0.07)]),
    "welded, two equal balls on a foot": (None, False, rolling(("foot", 0.05), ("sole", 0.05), ("hand", 0.02))),
    "welded, a rocker and a ball on a foot": (
        None, False, [Contact("foot", "line", "x", 0.05), *rolling(("sole", 0.2))]),
    "three unequal balls on a base": (
        TIAGO, False, rolling(("base_link", 0.1), ("base_imu_link", 0.2), ("caster_front_left_1_link", 0.0))),
    "quadruped with scalar sensors": (ANYMAL, False, scalar(rolling(*((f"{leg}_FOOT", 0.0) for leg in LEGS)))),
    "balls, two with scalar sensors": (
        ANYMAL, False, scalar(rolling(*((f"{leg}_FOOT", 0.04) for leg in LEGS)), "LF_FOOT", "LH_FOOT")),
    "rockers with scalar sensors below sensors in limbs": (
        None, False, scalar([Contact("sole", "line", "x", 0.3, ASKEW), Contact("fin", "line", "z"),
                             Contact("thigh", "point", radius=0.1)], "sole", "fin")),
    "welded, a ball and a plate with a cell on a foot": (
        None, False, scalar([*rolling(("foot", 0.05)), Contact("sole", "flat")], "sole")),
    "bolted arm with a scalar sensor": (
        PANDA, True, scalar([*rolling(("panda_rightfinger", 0.02)), Contact("panda_hand", "line", "x")])),
}  # fmt: skip

ROLLING = [k for k, (_, _, feet) in MACHINES.items() if any(c.radius for c in feet)]
ROLLING = [k for k in ROLLING if not any(c.along_normal for c in MACHINES[k][2])]


@dataclass(frozen=True)
class Recorded:
    """What was recorded of a robot that differs from its URDF, with K (B, nv + 6 F, 12 L) and J (B, C, 6, nv + 6 F)."""

    robot: Robot
    oracle: Oracle
    contacts: tuple[Contact, ...]
    log: Log
    K: Array
    J: Array


@cache
def recorded(name: str) -> Recorded:
    urdf, fixed_base, contacts = MACHINES[name]
    robot = load(urdf or machine(Path.cwd()), None, fixed_base, () if urdf or "welded" in name else SENSORS)
    oracle, rng = RollingOracle.of(robot), np.random.default_rng(len(name))
    oracle.perturb(rng, 0.2)
    oracle.contacts = {contact.frame: contact for contact in contacts}
    if "recorded ground" in name:
        oracle.normals = {contact.frame: unit(rng.normal(size=(4, 3))) for contact in contacts}
    if fixed_base:
        mounting = Rotation.from_rotvec([0.4, -0.7, 0.2])
        oracle.model.gravity.linear, oracle.mounting = mounting.inv().apply(GRAVITY), mounting.as_matrix()
    count = len(contacts)
    states = [[foot in down for foot in range(count)] for down in (range(count), [0], [count - 1], [])]
    log = make_log(oracle, [(contact.frame, contact.components) for contact in contacts], states, len(states), rng)
    if fixed_base:
        log = replace(log, base_quat_xyzw=np.tile(mounting.as_quat(), (len(log), 1)))
    if oracle.normals:
        normals = np.stack(list(oracle.normals.values()), axis=1)
        log = replace(log, contact_normal_world=np.where(value(log.contact_active)[..., None], normals, np.nan))
    log = with_scalar_readings(log, contacts)
    state = states_of(log)
    K = np.concatenate([oracle.regressor(robot, *state), oracle.friction_regressor(robot, state[1])], axis=3)
    J = np.array([oracle.jacobian(state[0], contact.frame) for contact in contacts])
    J = J.reshape(count, len(log), 6, K.shape[1]).swapaxes(0, 1)
    return Recorded(robot, oracle, tuple(contacts), log, K.reshape(*K.shape[:2], -1), J)


def with_scalar_readings(log: Log, contacts: Sequence[Contact]) -> Log:
    """The log with the forces along the normal that its scalar sensors read, in place of fz."""
    along = np.array([contact.along_normal for contact in contacts], dtype=bool)
    if not along.any():
        return log
    return replace(log, contact_force_normal=np.where(along, value(log.contact_wrench_local)[..., 2], np.nan))


# ------------------------------------------------------------------------------------------ sensors and conventions


def some(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """About half of what could be measured, component by component."""
    return rng.random(shape) < 0.5


SETS = ("full", "contacts only", "torques only", "limbs only", "some components")


def sensor_set(name: str, robot: Robot, contacts: Sequence[Contact]) -> SensorSet:
    """One of `SETS`; without sensors in limbs, "limbs only" measures nothing but the motion."""
    count, readable = len(contacts), np.ones((len(contacts), 6), dtype=bool)
    readable[[contact.along_normal for contact in contacts]] = np.arange(6) == 2
    if name == "some components":
        rng = np.random.default_rng(1)
        return SensorSet(some(rng, robot.n_dofs), some(rng, count, 6) & readable, NOISE)
    joint = np.arange(robot.n_dofs) < robot.n
    torque = joint & (name in ("full", "torques only")) | ~joint & (name in ("full", "limbs only"))
    return SensorSet(torque, readable & (name in ("full", "contacts only")), NOISE)


def in_other_order(log: Log) -> Log:
    """Joints, contacts and sensors in limbs from last to first."""

    def backwards(fields: Sequence[str]) -> dict[str, Any]:
        values = {name: getattr(log, name) for name in fields}
        return {name: None if x is None else np.flip(x, axis=1).copy() for name, x in values.items()}

    return replace(
        log,
        joint_names=log.joint_names[::-1],
        contact_names=log.contact_names[::-1],
        ft_names=log.ft_names[::-1],
        **backwards(["joint_position", "joint_velocity", "joint_acceleration", "joint_torque"]),
        **backwards(["contact_active", "contact_wrench_local", "contact_wrench_world", "contact_normal_world"]),
        **backwards(["contact_force_normal"]),
        **backwards(["ft_wrench"]),
    )


def with_base_imu(r: Recorded, log: Log, keep: Sequence[str] = ()) -> Log:
    """Readings of an IMU at the base's last link in place of the base's pose."""
    return with_imu(r.oracle, log, r.robot.bodies[0].links[-1], keep)


Convention = Callable[[Recorded, Log], Log]
ANY_BASE: dict[str, Convention] = {
    "frames": lambda r, log: log,
    "world, other order": lambda r, log: in_other_order(in_world(r.oracle, log)),
}
FREE_BASE: dict[str, Convention] = {
    "IMU": with_base_imu,
    "IMU, plates": lambda r, log: with_base_imu(r, on_plates(r.oracle, log), ["base_quat_xyzw"]),
}
CONVENTIONS = ANY_BASE | FREE_BASE
"""Axes that contact wrenches are along, names from last to first, and an IMU's readings in place of the base's pose."""
CASES = [
    (name, convention)
    for name, (_, fixed_base, contacts) in MACHINES.items()
    for convention in (ANY_BASE if fixed_base else CONVENTIONS)
    if convention != "IMU" or not any(contact.radius or contact.along_normal for contact in contacts)
]


def with_wild_unmeasured_forces(r: Recorded, sensors: SensorSet) -> Log:
    """The log with other readings where the sensors do not measure, as a force in contact, in a joint or in a limb."""
    rng, n = np.random.default_rng(1), r.robot.n
    wrench, torque = value(r.log.contact_wrench_local).copy(), value(r.log.joint_torque).copy()
    wrench[:, ~sensors.wrench] += 1e3 * rng.normal(size=wrench[:, ~sensors.wrench].shape)
    torque[:, ~sensors.torque[:n]] += 1e3 * rng.normal(size=torque[:, ~sensors.torque[:n]].shape)
    log = with_scalar_readings(replace(r.log, contact_wrench_local=wrench, joint_torque=torque), r.contacts)
    if log.ft_wrench is not None:
        limbs, unread = log.ft_wrench.copy(), ~sensors.torque[n:].reshape(-1, 6)
        limbs[:, unread] += 1e3 * rng.normal(size=limbs[:, unread].shape)
        log = replace(log, ft_wrench=limbs)
    return log


# -------------------------------------------------------------------------------------------------------------- rows


def base_axes(quat_xyzw: Array) -> Array:
    """Axes that the noise of the base is along, as columns: its own, tilted until the nearest one is vertical."""
    up = Rotation.from_quat(quat_xyzw).inv().apply([0.0, 0.0, 1.0])
    nearest = np.where(np.abs(up) == np.abs(up).max(), np.sign(up), 0.0)
    across = np.cross(nearest, up)
    angle = np.arctan2(np.linalg.norm(across), nearest @ up)
    return Rotation.from_rotvec(angle * across / np.linalg.norm(across)).as_matrix()


def measured_force(r: Recorded, log: Log, sensors: SensorSet, i: int) -> tuple[Array, Array, Array]:
    """Of one sample: f (nv + 6 F,), its covariance, and what each unmeasured force does to it, (k_x, nv + 6 F).

    The covariance is that of a log in its own convention: without an orientation it is along the base's own axes.
    """
    base, n = r.robot.base_rows, r.robot.n
    std = np.concatenate([BASE[:base], np.full(n, JOINT), np.tile(LIMB, len(r.robot.ft_names))])
    limbs = () if r.log.ft_wrench is None else r.log.ft_wrench[i].flatten()
    torque = np.append(value(r.log.joint_torque)[i], limbs)
    f, covariance = np.append(np.zeros(base), np.where(sensors.torque, torque, 0.0)), np.diag(std**2)
    if base and log.base_quat_xyzw is not None:
        axes = np.kron(np.eye(2), base_axes(log.base_quat_xyzw[i]))
        covariance[:6, :6] = axes @ covariance[:6, :6] @ axes.T
    unmeasured = [np.eye(len(std))[base:][~sensors.torque]]
    for c, contact in enumerate(r.contacts):
        if value(r.log.contact_active)[i, c]:
            can = np.isin(range(6), contact.components)
            seen, unseen = r.J[i, c][can & sensors.wrench[c]], r.J[i, c][can & ~sensors.wrench[c]]
            f += seen.T @ value(r.log.contact_wrench_local)[i, c][can & sensors.wrench[c]]
            covariance += seen.T @ np.diag(WRENCH[can & sensors.wrench[c]] ** 2) @ seen
            unmeasured.append(unseen)
    return f, covariance, np.concatenate(unmeasured)


def rows_of(r: Recorded, builder: RowBuilder, log: Log) -> tuple[Array, Array]:
    """All rows [K | f], (B, n_rows, 12 L + 1), and the basis W that made them, (B, n_rows, n_rows)."""
    samples, M = bind_log(log, r.robot, r.contacts, builder.sensors), torch.from_numpy(builder.columns.parameter_map)
    n_rows = builder.tree.n_rows
    rows, W = (torch.zeros(len(log), n_rows, k, dtype=torch.float64) for k in (M.shape[1] + 1, n_rows))
    for state, index in chunks_by_state(samples):
        found, W[index] = builder.rows_by_sample(samples[index], state)
        rows[index] = torch.cat([found[..., :-1] @ M, found[..., -1:]], dim=2)
    return rows.numpy(), W.numpy()


def assert_close(found: Array, expected: Array, size: float) -> None:
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=EXACT * size)


@cache
def row_builder(name: str, sensors: str) -> RowBuilder:
    r = recorded(name)
    return RowBuilder(r.robot, r.contacts, sensor_set(sensors, r.robot, r.contacts))


def always(number: int, name: str, convention: str, sensors: str) -> bool:
    """Whether a case of the so manieth machine always runs: one set as recorded, and one in another convention.

    What is measured, how it was recorded and what touches are three steps of the code, one after the other.
    """
    if convention == "frames":
        return sensors == SETS[number % len(SETS)]
    others = [x for machine, x in CASES if machine == name and x != "frames"]
    return convention == others[number % len(others)] and sensors == MIXED[number // 3 % 2]


MIXED = ("full", "some components")


@pytest.mark.parametrize(
    ("name", "convention", "sensors"),
    [
        pytest.param(*case, sensors, marks=[] if always([*MACHINES].index(case[0]), *case, sensors) else STUDY)
        for case in CASES
        for sensors in SETS
    ],
)
def test_rows_are_white_combinations_of_pinocchios_equations_that_no_unmeasured_force_enters(
    name: str, convention: str, sensors: str
) -> None:
    r, recorded_as = recorded(name), CONVENTIONS[convention]
    builder = row_builder(name, sensors)
    chosen = builder.sensors
    log = recorded_as(r, r.log)
    rows, W = rows_of(r, builder, log)
    size = np.abs(W).max(initial=1.0) * max(np.abs(r.K).max(), 100.0)
    for i in range(len(r.log)):
        f, covariance, unmeasured = measured_force(r, log, chosen, i)
        kept = W[i].any(axis=0)
        assert kept.sum() == len(f) - np.linalg.matrix_rank(unmeasured)
        assert_close(unmeasured @ W[i], 0.0, np.abs(W[i]).max(initial=1.0))
        assert_close(W[i].T @ covariance @ W[i], np.diag(kept.astype(float)), 10.0)
        assert_close(rows[i, :, :-1], W[i].T @ r.K[i], size)
        assert_close(rows[i, :, -1], W[i].T @ f, size)
    phi = true_parameters(r.oracle, r.robot).flatten()
    assert_close(rows[..., :-1] @ phi, rows[..., -1], np.abs(rows[..., -1]).max(initial=1.0))
    again, _ = rows_of(r, builder, recorded_as(r, with_wild_unmeasured_forces(r, chosen)))
    assert_close(again, rows, size)


@pytest.mark.parametrize("name", ROLLING)
def test_forces_measured_where_contacts_roll_are_those_that_the_true_parameters_predict(name: str) -> None:
    r = recorded(name)
    builder = row_builder(name, "full")
    for log in (r.log, in_world(r.oracle, r.log)):
        phi = true_parameters(r.oracle, r.robot).flatten()
        measured, (predicted,) = force_series(builder, bind_log(log, r.robot, r.contacts), phi[None])
        assert_close(predicted, measured, np.abs(measured).max())


@pytest.mark.parametrize(("name", "sensors"), each_once([*MACHINES], SETS))
def test_the_factor_of_a_log_holds_the_same_rows(name: str, sensors: str) -> None:
    r, builder = recorded(name), row_builder(name, sensors)
    rows, W = rows_of(r, builder, r.log)
    factor = compress([bind_log(r.log, r.robot, r.contacts)], builder, chunk=3)
    problem = linear_problem(factor, builder, r.robot)
    assert factor.rows == W.any(axis=1).sum()
    expected = rows.reshape(-1, rows.shape[2])
    found = np.column_stack([problem.A, problem.b])
    size = np.maximum(np.linalg.norm(expected, axis=0), 1e-3 * np.linalg.norm(expected))
    size[size == 0.0] = 1.0
    gram = expected.T @ expected
    gram[-1, -1] -= problem.residual
    np.testing.assert_allclose(
        found.T @ found / np.outer(size, size), gram / np.outer(size, size), rtol=0.0, atol=1e-13
    )


def test_a_force_that_no_measured_joint_feels_takes_no_equation() -> None:
    """Along y and about x of the fin's sensor, of which x and the moment about y are measured."""
    r = recorded("bolted skew tree with sensors in limbs")
    wrench = np.zeros((3, 6), dtype=bool)
    wrench[2, [0, 2, 4]] = True
    sensors = SensorSet(np.isin(r.robot.dof_names, ["tail_ft.fx", "tail_ft.my"]), wrench, NOISE)
    fin_alone = bind_log(r.log, r.robot, r.contacts)[2:3]
    assert fin_alone.active.tolist() == [[False, False, True]]
    assert compress([fin_alone], RowBuilder(r.robot, r.contacts, sensors)).rows == 2
