"""Force/torque sensors at the fixed joints of a limb, against Pinocchio with these joints free and at rest."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from regressors import base_kinds, regressor
from synthetic import Oracle, load, make_log, random_states
from true_robots import hide, worst
from urdfs import BASE, inertial, joint, link, write
from welded import CONTACTS, REAL, SENSORS, STATES, machine

from torchid import parameters
from torchid.errors import LogError, UnknownNameError
from torchid.estimators import LeastSquares
from torchid.identifiability.base_parameters import state_reports
from torchid.parameters import WRENCH_COMPONENTS
from torchid.problem import RowBuilder, Samples, bind_log, compress, linear_problem
from torchid.regressor import FrameJacobian
from torchid.robot import Robot, load_robot
from torchid.sensing import SensorSet, chosen_sensors, named_sensors, with_ft_sensors

EXACT = 1e-14  # of the largest number; 3e-15 measured


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return machine(tmp_path_factory.mktemp("welded"))


def assert_oracles(robot: Robot, seed: int) -> None:
    """Columns of K, nominal forces and Jacobians of many links are Pinocchio's."""
    oracle = Oracle.of(robot)
    state = random_states(np.random.default_rng(seed), robot.n, 3, robot.fixed_base)
    K, expected = regressor(robot, *state), oracle.regressor(robot, *state)
    np.testing.assert_allclose(K[..., :10], expected, rtol=0.0, atol=EXACT * np.abs(expected).max())
    forces, nominal = oracle.frictionless_forces(*state), robot.nominal[:, :10]
    found = np.einsum("bilk,lk->bi", K[..., :10], nominal)
    np.testing.assert_allclose(found, forces, rtol=0.0, atol=EXACT * np.abs(forces).max())
    assert np.abs(forces[:, robot.nv :]).max() > 1e-3 * np.abs(forces).max(), "the sensors must read something"
    frames = list(robot.links)
    for frame in {frames[-1], *frames[:: 1 + len(frames) // 4]}:
        J = FrameJacobian(robot, frame)(torch.from_numpy(state[0])).numpy()
        np.testing.assert_allclose(J, oracle.jacobian(state[0], frame), rtol=0.0, atol=EXACT, err_msg=frame)


@pytest.mark.parametrize(("name", "fixed_base"), [(name, place % 2 == 1) for place, name in enumerate(REAL)])
def test_the_wrench_through_a_weld_is_that_of_a_free_joint_at_rest(name: str, fixed_base: bool) -> None:
    path, welds = REAL[name]
    robot = load(path, None, fixed_base, welds)
    assert set(robot.ft_names) == set(welds)
    assert_oracles(robot, 0)


@base_kinds
@pytest.mark.parametrize("sensors", [SENSORS, SENSORS[:1], SENSORS[1:3]], ids="+".join)
def test_skew_welds_in_a_row_above_a_slide_at_the_base_and_beyond_a_mimic_joint(
    urdf: Path, sensors: tuple[str, ...], fixed_base: bool
) -> None:
    assert_oracles(load(urdf, None, fixed_base, sensors), 1)


def test_a_sensor_under_a_hanging_mass_reads_its_weight_and_beside_the_lever_its_moment(tmp_path: Path) -> None:
    turned = '<origin xyz="1 2 3" rpy="3.141592653589793 0 0"/>'  # the child's y and z point backwards and down
    parts = (
        BASE,
        link("tool", inertial("2", '<origin xyz="0.3 0 0"/>')),
        joint("flange", "base", "tool", "fixed", turned),
    )
    robot = load_robot(write(tmp_path, *parts), ft_joints=["flange"])
    q, still = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]), np.zeros((1, 6))
    (reading,) = np.einsum("bilk,lk->bi", regressor(robot, q, still, still), robot.nominal)[:, 6:]
    weight = 2.0 * 9.81  # the parent holds the tool up, along -z of the child
    np.testing.assert_allclose(reading, [0, 0, -weight, 0, 0.3 * weight, 0], rtol=0.0, atol=1e-12)


# ------------------------------------------------------------------------------------------------ rows and fits

SETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "limbs alone": ("none", SENSORS),
    "the base's and the tail's": ("none", ("mount_ft", "tail_ft")),
    "torques, the base's and the tail's": ("joints", ("mount_ft", "tail_ft")),
    "contacts and thigh": ("contacts", ("thigh_ft",)),
    "everything": ("full", SENSORS),
}


def sensors_of(robot: Robot, name: str) -> SensorSet:
    """One of `SETS`."""
    beside, welds = SETS[name]
    if beside == "none":
        sensors = chosen_sensors(robot.joint_names, CONTACTS, [], {}, ft=len(SENSORS))
    else:
        sensors = named_sensors(beside, robot.n, len(CONTACTS), ft=len(SENSORS))
    return with_ft_sensors(sensors, robot, welds)


def recorded(robot: Robot, seed: int, samples: int = 200) -> tuple[Oracle, Samples]:
    """A robot that differs from its URDF, and what was recorded of it in contact before, beyond and between sensors."""
    oracle, rng = Oracle.of(robot), np.random.default_rng(seed)
    oracle.perturb(rng, 0.2)
    contacts = [(contact.frame, len(contact.components)) for contact in CONTACTS]
    return oracle, bind_log(make_log(oracle, contacts, STATES, samples, rng), robot, CONTACTS)


@base_kinds
@pytest.mark.parametrize("name", SETS)
def test_limb_sensors_mixed_with_others_find_all_that_they_can_see(urdf: Path, name: str, fixed_base: bool) -> None:
    robot = load(urdf, None, fixed_base, SENSORS)
    oracle, samples = recorded(robot, 5)
    sensors = sensors_of(robot, name)
    builder = RowBuilder(robot, CONTACTS, sensors)
    estimate = LeastSquares().solve(linear_problem(compress([hide(samples, sensors)], builder), builder, robot))
    assert estimate.residual_std < 1e-11
    if not fixed_base:
        assert {report.base_rank for report in state_reports([samples], builder)} == {6}
    state = random_states(np.random.default_rng(99), robot.n, 100, fixed_base)
    found = np.einsum("bilk,lk->bi", regressor(robot, *state), estimate.phi.reshape(-1, parameters.PER_BODY))
    seen = np.append(np.ones(robot.base_rows, dtype=bool), sensors.torque)
    true = oracle.forces(*state)
    assert worst(found[:, seen], true[:, seen]) < 1e-11
    nominal = np.einsum("bilk,lk->bi", regressor(robot, *state), robot.nominal)
    assert worst(nominal[:, seen], true[:, seen]) > 0.01


# ----------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("name", "what"), [("hip", "a revolute joint, not"), ("sole", "a link, not"), ("ankle", "a"), ("ankl", "unknown")]
)
def test_a_sensor_can_sit_at_a_fixed_joint_only(urdf: Path, name: str, what: str) -> None:
    with pytest.raises(UnknownNameError, match=f"'{name}'.*accepted: .*ankle_ft") as caught:
        load_robot(urdf, ft_joints=[name])
    assert what in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"ft_names": (), "ft_wrench": None}, "ft_wrench: missing; accepted: the field, or "),
        ({"ft_wrench": None}, "ft_wrench: missing; accepted: the field, or "),
        ({"ft_names": ("x", "y", *SENSORS[2:])}, f"ft_names: missing sensors: {SENSORS[0]}, {SENSORS[1]}; accepted: "),
    ],
    ids=["not in the log", "no readings", "other names"],
)
def test_a_sensor_that_was_not_recorded_is_refused_where_it_is_needed(urdf: Path, change: dict, found: str) -> None:
    robot = load(urdf, None, False, SENSORS)
    log = make_log(Oracle.of(robot), [], [[]], 5, np.random.default_rng(8))
    sensors = with_ft_sensors(named_sensors("joints", robot.n, 0, ft=len(SENSORS)), robot, SENSORS)
    with pytest.raises(LogError) as caught:
        bind_log(replace(log, **change), robot, (), sensors)
    assert str(caught.value).startswith(f"synthetic.npz: {found}")


def test_one_reading_that_is_not_a_number_is_named_with_its_sensor_and_sample(urdf: Path) -> None:
    robot = load(urdf, None, False, SENSORS)
    log = make_log(Oracle.of(robot), [], [[]], 5, np.random.default_rng(9))
    assert log.ft_wrench is not None
    log.ft_wrench[3, log.ft_names.index("ankle_ft"), WRENCH_COMPONENTS.index("my")] = np.nan
    sensors = with_ft_sensors(named_sensors("joints", robot.n, 0, ft=len(SENSORS)), robot, ["ankle_ft"])
    with pytest.raises(LogError, match=r"ft_wrench 'ankle_ft.my'.*sample 3 \(in 1 sample\)"):
        bind_log(log, robot, (), sensors)
    bind_log(log, robot, (), named_sensors("joints", robot.n, 0, ft=len(SENSORS)))
