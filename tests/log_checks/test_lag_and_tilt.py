"""Torques that are late or off by a constant, gravity that is not vertical, and a base that turns in one place."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import CONTACTS, demo_log, demo_robot, of_demo, only
from mistaken import Case, case_of, checked
from motions import value
from scipy.spatial.transform import Rotation
from synthetic import Array
from thinned import each_once
from walking import MACHINES

from torchid.commands.identify import identify
from torchid.config import load_config
from torchid.log_checks import NOTE, SUSPICIOUS, Checked
from torchid.log_checks.readings import check_excitation, check_rest, check_still_base
from torchid.logs import Log, write_log
from torchid.logs.preprocess import preprocess
from torchid.logs.segments import with_delayed, with_delayed_torques
from torchid.problem import bind_log
from torchid.problem.samples import is_at_rest

VECTORS = ("base_position_world", "base_linear_velocity_world", "base_linear_acceleration_world")


def alarms(found: Checked) -> list[tuple[str, str]]:
    return [(one.name, one.field) for one in found.findings if one.severity != NOTE]


def tilted(log: Log, rotvec_deg: Array) -> Log:
    """The same motion as told in a world that is turned."""
    R = Rotation.from_rotvec(np.radians(rotvec_deg))
    turned: dict[str, Any] = {name: R.apply(x) for name in VECTORS if (x := getattr(log, name)) is not None}
    if log.contact_wrench_world is not None:
        turned["contact_wrench_world"] = log.contact_wrench_world @ np.kron(np.eye(2), R.as_matrix().T)
    return replace(log, base_quat_xyzw=(R * Rotation.from_quat(value(log.base_quat_xyzw))).as_quat(), **turned)


OF_FILTERS_MS = 5.0  # those of the sensors of some robots are late by 10 ms
CASES = [("arm", "contacts"), ("quadruped", "full"), ("biped", "joints")]


@pytest.mark.parametrize(("robot", "seconds"), each_once(CASES, [0.1, -0.06]))
def test_torques_that_are_late_or_early_are_named_with_the_time(robot: tuple[str, str], seconds: float) -> None:
    machine, sensors = robot
    case = case_of(MACHINES[machine], sensors)
    finding = only(checked(case, with_delayed_torques(case.log, seconds)), "delay", "joint_torque")
    assert finding.severity == SUSPICIOUS
    found = re.match(r"torques are ([\d.]+) \+- ([\d.]+) ms (later|earlier)", finding.found)
    assert found is not None
    late = float(found[1]) * (1.0 if found[3] == "later" else -1.0)
    assert late == pytest.approx(1e3 * seconds + OF_FILTERS_MS, abs=8.0)
    assert float(found[2]) < 10.0
    shift = re.search(r"actuators.delay: (-?[\d.]+)$", finding.advice)
    assert shift is not None
    assert float(shift[1]) == pytest.approx(-1e-3 * late, rel=0.06)


@pytest.mark.parametrize(("robot", "share"), each_once([("arm", "contacts"), ("quadruped", "full")], [0.5, -0.8]))
def test_a_torque_that_is_off_by_a_constant_is_named_with_its_size(robot: tuple[str, str], share: float) -> None:
    case = case_of(MACHINES[robot[0]], robot[1])
    torque = value(case.log.joint_torque).copy()
    offset = share * float(np.sqrt(np.square(torque).mean()))
    torque[:, 1] += offset
    finding = only(checked(case, replace(case.log, joint_torque=torque)), "offset", "joint_torque")
    found = re.match(r"(\S+): torques read ([\d.]+) \+- ([\d.]+) N m too (much|little)", finding.found)
    assert found is not None
    assert found[1] == case.log.joint_names[1]
    assert found[4] == ("much" if share > 0.0 else "little")
    assert float(found[2]) == pytest.approx(abs(offset), abs=max(3.0 * float(found[3]), 0.1 * abs(offset)))
    assert "sensors.offsets: {joint_torque: log}" in finding.advice


@pytest.mark.parametrize("machine", ["quadruped", "biped", "demo"])
def test_a_world_that_is_tilted_is_named_with_the_angles(machine: str) -> None:
    case: Case | None = None if machine == "demo" else case_of(MACHINES[machine], "full")
    log = demo_log() if case is None else case.log
    slanting = tilted(log, np.array([9.6, -7.2, 0.0]))
    finding = only(of_demo(slanting) if case is None else checked(case, slanting), "tilt", "base_quat_xyzw")
    assert finding.severity == SUSPICIOUS
    found = re.match(r"gravity is ([\d.]+) degrees from down \(([-\d.]+) and ([-\d.]+) about the world", finding.found)
    assert found is not None
    assert float(found[2]) == pytest.approx(9.6, abs=2.0)
    assert float(found[3]) == pytest.approx(-7.2, abs=2.0)
    assert "base_tilt: auto" in finding.advice


READINGS = {
    "torques": {"joint_torque": slice(None)},
    "contact forces": {"contact_wrench_local": slice(None), "contact_active": slice(None)},
    "forces of r_sole": {"contact_wrench_local": slice(1, 2), "contact_active": slice(1, 2)},
    "the joints' motion": {"joint_position": slice(None)},
}


@pytest.mark.parametrize(
    ("late", "rate"),
    [("contact forces", 0.0), ("forces of r_sole", 0.0), ("torques", 0.003), ("contact forces", 0.003)]
    + [pytest.param("the joints' motion", 0.0, marks=pytest.mark.study)],
)
def test_of_torques_forces_and_motion_the_one_that_the_others_contradict_is_late(late: str, rate: float) -> None:
    """By 30 ms, or by a clock that is 0.3 % fast, from 0 to 36 ms."""
    case = case_of(MACHINES["biped"], "full")
    seconds = rate * case.log.time if rate else 0.03
    log = with_delayed(case.log, seconds, READINGS[late])
    (finding,) = (one for one in checked(case, log).findings if one.name in ("delay", "clock"))
    assert finding.field == next(iter(READINGS[late]))
    assert "; or " not in finding.found
    if rate:
        found = re.match(rf"{late} are .*\(\+- ([\d.]+) ms\): a clock that is ([\d.]+) % fast", finding.found)
        assert found is not None
        certain = 1e-3 * float(found[1]) / case.log.time[-1]
        assert 1e-2 * float(found[2]) == pytest.approx(rate, abs=max(3.0 * certain, 2e-4))
    else:
        found = re.match(rf"{late} (?:are|is) ([\d.]+) \+- [\d.]+ ms later", finding.found)
        assert found is not None
        assert float(found[1]) == pytest.approx(30.0, abs=5.0)


@pytest.mark.parametrize(
    ("world", "by"), each_once([("y", [-90.0, 0.0, 0.0]), ("x", [0.0, 90.0, 0.0])], ["feet", "IMU"])
)
def test_a_world_whose_z_axis_is_level_is_named_with_the_axis_that_points_up(
    world: tuple[str, list[float]], by: str
) -> None:
    axis, turn = world
    if by == "feet":
        finding = only(of_demo(tilted(demo_log(), np.array(turn))), "unit, sign or frame", "base_quat_xyzw")
        assert finding.found.startswith(f"in a world whose {axis} axis points up")
    else:
        case = case_of(MACHINES["quadruped"], "joints")
        finding = only(checked(case, tilted(case.log, np.array(turn))), "gravity", "base_quat_xyzw")
        assert finding.found.endswith(f"a world whose {axis} axis points up?")


def test_forces_that_nobody_measured_have_no_offset_and_no_warning() -> None:
    log = demo_log()
    torque, wrench = (np.full_like(value(x), np.nan) for x in (log.joint_torque, log.contact_wrench_local))
    unmeasured = of_demo(replace(log, joint_torque=torque, contact_wrench_local=wrench))
    assert not [one for one in unmeasured.findings if one.name == "offset"]


def test_an_arm_on_a_table_that_slants_is_told_so() -> None:
    case = case_of(MACHINES["arm"], "contacts")
    gravity = Rotation.from_rotvec(np.radians([0.0, 12.0, 0.0])).apply([0.0, 0.0, -9.81])
    torque = slanting_torque(case, gravity)
    finding = only(checked(case, replace(case.log, joint_torque=torque)), "tilt", "base")
    assert "about the base's own x and y axes" in finding.found
    assert re.match(r"gravity is 1[0-4]", finding.found)


@pytest.mark.filterwarnings("ignore:.*large part of these accelerations is noise")
@pytest.mark.parametrize(
    ("degrees", "stated", "told"), [(12.0, "", True), (12.0, ", base_tilt: auto", False), (0.0, "", False)]
)
def test_identify_says_that_the_table_of_an_arm_slants(
    tmp_path: Path, degrees: float, stated: str, told: bool, recwarn: pytest.WarningsRecorder
) -> None:
    """Masses make up for most of it: errors are a tenth of the URDF's."""
    case = case_of(MACHINES["arm"], "contacts")
    gravity = Rotation.from_rotvec(np.radians([0.0, degrees, 0.0])).apply([0.0, 0.0, -9.81])
    write_log(replace(case.log, joint_torque=slanting_torque(case, gravity)), tmp_path / "arm.npz")
    (tmp_path / "arm.yaml").write_text(
        f"robot: {{urdf: {case.machine.urdf}, fixed_base: true{stated}}}\nlogs: [arm.npz]\n"
        "preprocessing: {cutoff_hz: 10}\nsensors: joints\nestimator: {name: least_squares, ridge: 1e-4}\n"
        f"output: {tmp_path / 'run'}\n"
    )
    identify(load_config(tmp_path / "arm.yaml"))
    said = [str(one.message) for one in recwarn if "robot.base_tilt" in str(one.message)]
    assert bool(said) is told
    assert all(re.search(r"gravity is 1[0-4] degrees from down .*base_tilt: auto", one) for one in said)


def slanting_torque(case: Case, gravity: Array) -> Array:
    """Recorded torques with what another direction of gravity adds to them, by Pinocchio and the URDF."""
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(case.machine.urdf))
    data, q = model.createData(), case.log.joint_position
    order = [model.getJointId(name) - 1 for name in case.log.joint_names]
    loads = []
    for g in (gravity, np.array([0.0, 0.0, -9.81])):
        model.gravity.linear = g
        at = np.zeros((len(q), model.nv))
        at[:, order] = q
        loads.append(np.array([pin.computeGeneralizedGravity(model, data, one) for one in at])[:, order])
    return np.asarray(value(case.log.joint_torque) + loads[0] - loads[1])


@pytest.mark.parametrize(
    ("recorded", "mistaken"),
    each_once(
        [("quadruped", "full"), ("biped", "full"), ("quadruped", "contacts")],
        [("sign", "sign", "reversed; times -"), ("gain", "scale", "times 0.6"), ("turn", "frame", "turned by [23]")],
    ),
)
def test_the_one_contact_sensor_that_is_reversed_scaled_or_turned_is_named(
    recorded: tuple[str, str], mistaken: tuple[str, str, str]
) -> None:
    (machine, sensors), (mistake, name, text) = recorded, mistaken
    case = case_of(MACHINES[machine], sensors)
    change = {"sign": -np.eye(3), "gain": 1.6 * np.eye(3), "turn": Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix()}
    wrench = value(case.log.contact_wrench_local).copy()
    wrench[:, 1] = wrench[:, 1] @ np.kron(np.eye(2), change[mistake].T)
    found = checked(case, replace(case.log, contact_wrench_local=wrench))
    (finding,) = (one for one in found.findings if one.name == name and one.severity == SUSPICIOUS)
    assert finding.field == "contact_wrench_local"
    assert finding.channels == (case.log.contact_names[1],)
    assert re.search(text, finding.found)


def test_a_base_that_turns_in_one_place_is_named_unless_nothing_is_derived_from_that() -> None:
    rates: dict[str, Any] = dict.fromkeys(VECTORS[1:])
    log = demo_log()
    still = replace(log, base_position_world=np.tile(value(log.base_position_world)[:1], (len(log), 1)), **rates)
    finding = only(of_demo(still), "constant position", "base_position_world")
    assert finding.severity == SUSPICIOUS
    assert "the base turns by 19 degrees" in finding.found
    assert "base_motion: contacts" in finding.advice
    moving = replace(still, base_linear_velocity_world=0.1 * np.random.default_rng(0).normal(size=(len(log), 3)))
    (known,) = check_still_base(moving)
    assert known.severity == NOTE
    assert not list(check_still_base(replace(still, base_quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1)))))


@pytest.mark.filterwarnings("ignore:.*no joint moves:torchid.errors.TorchidWarning")
@pytest.mark.parametrize("moves", ["nothing", "a joint", "the base"])
def test_a_log_in_which_nothing_moves_is_named(moves: str) -> None:
    log = demo_log()
    noise = np.random.default_rng(0).normal(scale=1e-4, size=(len(log), 1))
    rest = {name: getattr(log, name)[:1] + noise for name in ("joint_position", "base_position_world")}
    rest["base_quat_xyzw"] = np.tile(value(log.base_quat_xyzw)[:1], (len(log), 1))
    if moves == "a joint":
        rest["joint_position"][:, 3] = log.joint_position[:, 3]
    elif moves == "the base":
        rest["base_quat_xyzw"] = value(log.base_quat_xyzw)
    still = replace(log, **rest)
    assert is_at_rest([bind_log(preprocess(still, 8.0), demo_robot(), CONTACTS)]) == (moves == "nothing")
    findings = list(check_excitation(still))
    assert [(one.name, one.severity) for one in findings] == ([("no motion", NOTE)] if moves == "nothing" else [])


def test_joints_that_rest_while_others_move_are_named_with_their_share_of_the_time() -> None:
    log, rng, third = demo_log(), np.random.default_rng(0), len(demo_log()) // 3
    position = log.joint_position.copy()
    position[:, 2] = position[0, 2]
    position[third : 2 * third, 5] = position[third, 5]
    moves, rests = (
        replace(log, joint_position=x + 1e-5 * rng.normal(size=x.shape)) for x in (log.joint_position, position)
    )
    assert list(check_rest(moves)) == []
    [found] = check_rest(rests)
    assert (found.name, found.severity) == ("rest", NOTE)
    assert found.channels == (log.joint_names[2], log.joint_names[5])
    shares = [float(x) for x in re.findall(r"(\d+) %", found.found)]
    assert shares[0] >= 98.0
    assert 30.0 <= shares[1] <= 40.0
    assert list(check_rest(replace(rests, joint_torque=None))) == []


def test_clean_logs_give_no_alarm() -> None:
    assert alarms(of_demo(demo_log())) == []
    for machine, sensors in CASES:
        case = case_of(MACHINES[machine], sensors)
        assert alarms(checked(case, case.log)) == [], machine
