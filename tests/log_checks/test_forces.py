"""Forces that contradict the URDF: which mistake is named, with which numbers, beside URDFs that are 15 % off."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from faults import changed, demo_log, demo_robot, found, of_demo, only, scaled
from mistaken import Case, case_of, checked
from motions import value
from repository import CONFIGS, SHARED
from scipy.spatial.transform import Rotation
from synthetic import ROBOTS, Array, Oracle
from thinned import STUDY, each_once, study_but
from walking import MACHINES, robot_of

from torchid.commands.check import check_experiment
from torchid.commands.identify import identify
from torchid.config import load_config
from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Checked, Finding
from torchid.log_checks.check import check
from torchid.log_checks.equations import FilteredLog, NominalModel
from torchid.log_checks.motion import check_still_velocities, still_joints
from torchid.logs import Log, write_log
from torchid.logs.segments import with_delayed, with_delayed_torques
from torchid.parameters import VISCOUS, inertial_vector, mass_com_inertia
from torchid.regressor import Regressor
from torchid.robot import Robot
from torchid.sensing import Contact

EXPLAINED = "unit, sign or frame"
ELSEWHERE = pytest.mark.skipif(not SHARED.is_dir(), reason=f"recorded logs are not in {SHARED}")
WALKER = ("quadruped", "full")
ARM = MACHINES["arm"]


@cache
def arm() -> Case:
    """An arm whose bodies are 15 % off its URDF, with friction, noise and a filter of 10 ms."""
    return case_of(ARM, "contacts")


def of_arm(log: Log) -> Checked:
    return checked(arm(), log)


def torques(log: Log, change: Callable[[Array], object]) -> Log:
    """The log with torques changed in place."""

    def in_place(torque: Array) -> None:
        change(torque)

    return changed(log, "joint_torque", in_place)


def alarms(found: Checked) -> list[tuple[str, str]]:
    return [(one.name, one.field) for one in found.findings if one.severity != NOTE]


@pytest.mark.parametrize(
    ("machine", "sensors"), [("arm", "contacts"), ("quadruped", "joints"), pytest.param("biped", "full", marks=STUDY)]
)
def test_a_robot_unlike_its_urdf_gives_no_alarm(machine: str, sensors: str) -> None:
    case = case_of(MACHINES[machine], sensors)
    assert alarms(checked(case, case.log)) == []


def test_the_best_urdf_near_the_given_one_leaves_little_of_the_forces_unless_the_log_is_wrong() -> None:
    def unexplained(log: Log) -> float:
        return value(FilteredLog(log, NominalModel(robot_of(ARM), ()), 10.0).equations).unexplained

    log = arm().log
    assert unexplained(log) < 0.5
    assert unexplained(replace(log, joint_torque=-value(log.joint_torque))) > 2.0


# --------------------------------------------------------------------------------------------------- factors of torques


@pytest.mark.parametrize(
    ("factor", "name", "severity"),
    [(-1.0, "sign", REJECTED), (1e3, "unit", REJECTED), (0.02, "scale", SUSPICIOUS), (1.3, "scale", SUSPICIOUS)],
)
@pytest.mark.parametrize("recorded", study_but([("arm", "contacts")], [("arm", "contacts"), WALKER]))
def test_the_one_torque_with_another_factor_is_named_with_it(
    recorded: tuple[str, str], factor: float, name: str, severity: str
) -> None:
    case = case_of(MACHINES[recorded[0]], recorded[1])
    log = torques(case.log, lambda torque: torque[:, 1].__imul__(factor))
    finding = only(checked(case, log), name, "joint_torque")
    assert (finding.severity, finding.channels) == (severity, (case.log.joint_names[1],))
    stated = value(re.search(r"with a factor of (\S+) \+- (\S+?)[:;]", finding.found + ":"))
    assert float(stated[1]) == pytest.approx(1.0 / factor, rel=0.15)


def test_torques_of_motors_of_one_type_that_are_an_eighth_are_named_with_the_key_of_their_scale() -> None:
    finding = only(of_arm(torques(arm().log, lambda torque: torque[:, 1:4].__itruediv__(8.0))), "scale")
    names = arm().log.joint_names
    assert {names[1], names[3]} <= set(finding.channels) <= set(names[1:4])
    assert "or set sensors.scales: {joint_torque: [[" in finding.advice


@pytest.mark.parametrize("unit", study_but([1e3, 9.81], [1e3, 1e-3, 100.0, 9.81]))
def test_all_torques_in_another_unit_or_reversed_are_named_once(unit: float) -> None:
    log = demo_log().select(slice(0, 600))
    finding = only(of_demo(scaled(log, "joint_torque", unit)), EXPLAINED)
    assert (finding.severity, finding.field) == (REJECTED, "joint_torque")
    assert "logs.columns.joint_torque.unit" in finding.advice
    reversed_ = only(of_demo(scaled(log, "joint_torque", -1.0)), EXPLAINED)
    assert reversed_.found.startswith("all reversed")


@pytest.mark.parametrize("factor", study_but([1.2], [0.5, 1.2, 2.0]))
def test_torques_that_all_have_one_factor_contradict_the_contact_forces(factor: float) -> None:
    case = case_of(MACHINES[WALKER[0]], WALKER[1])
    found_ = checked(case, scaled(case.log, "joint_torque", factor))
    assert alarms(found_) == [("scale", "joint_torque")]
    stated = value(re.search("all torques: the URDF fits best with a factor of ([0-9.]+)", found_.findings[0].found))
    assert float(stated[1]) == pytest.approx(1.0 / factor, rel=0.2)


def test_a_torque_that_is_friction_alone_is_reversed_where_it_would_drive_its_joint() -> None:
    log = arm().log
    rate = np.gradient(log.joint_position[:, 6], log.time)
    friction = 4.0 * np.sign(rate) + 2.0 * rate  # [N m]; bodies beyond need 0.1
    assert alarms(of_arm(torques(log, lambda torque: torque[:, 6].__iadd__(friction)))) == []
    finding = only(of_arm(torques(log, lambda torque: torque[:, 6].__isub__(friction))), "sign")
    assert (finding.severity, finding.channels) == (REJECTED, (log.joint_names[6],))
    assert "It is mostly friction, which would drive the joint" in finding.found


def test_friction_of_the_urdf_that_the_forces_contradict_is_no_mistake_of_the_log() -> None:
    robot = robot_of(ARM)
    nominal = robot.nominal.copy()
    nominal[2, VISCOUS] = 400.0
    assert alarms(check(arm().log, replace(robot, nominal=nominal), (), 10.0)) == []


@pytest.mark.parametrize("recorded", study_but([("arm", "contacts")], [("quadruped", "joints"), WALKER]))
def test_torques_that_are_a_hundredth_are_named_with_their_factor(recorded: tuple[str, str]) -> None:
    case = case_of(MACHINES[recorded[0]], recorded[1])
    (finding,) = (x for x in checked(case, scaled(case.log, "joint_torque", 0.01)).findings if x.severity != NOTE)
    assert (finding.name, finding.field) == ("scale", "joint_torque")
    stated = value(re.search(r"all torques: the URDF fits best with a factor of ([0-9.]+)", finding.found))
    assert float(stated[1]) == pytest.approx(100.0, rel=0.15)


# ----------------------------------------------------------------------------------------- masses and inertias of files


def test_a_torque_that_is_a_hundredth_is_named_beside_forces_that_no_model_explains() -> None:
    log = arm().log
    ripple = np.sin(2.0 * np.pi * 3.0 * log.time + np.arange(len(log.joint_names))[:, None]).T
    torque = value(log.joint_torque)
    heaviest = int(np.square(torque).mean(axis=0).argmax())
    torque = torque + 0.3 * np.square(torque).mean(axis=0) ** 0.5 * ripple
    torque[:, heaviest] = 0.01 * value(log.joint_torque)[:, heaviest]
    said = [x for x in of_arm(replace(log, joint_torque=torque)).findings if x.name in ("scale", "unit")]
    assert [x.channels for x in said] == [(log.joint_names[heaviest],)]


def damaged(change: Callable[[float, Array, Array], tuple[float, Array, Array]], *bodies: int) -> Robot:
    """The arm with other masses, centres of mass and inertias of some bodies."""
    nominal = robot_of(ARM).nominal.copy()
    for body in bodies:
        nominal[body, :10] = inertial_vector(*change(*mass_com_inertia(nominal[body])))
    return replace(robot_of(ARM), nominal=nominal)


EVERY_BODY = range(8)


@pytest.mark.parametrize(
    ("change", "bodies", "fault"),
    [
        (lambda mass, com, inertia: (mass, com, 388.0 * inertia), EVERY_BODY, "a radius of gyration of"),
        (lambda mass, com, inertia: (100.0 * mass, com, inertia), [4], "a density of"),
        (lambda mass, com, inertia: (0.01 * mass, com, inertia), [4], "a density of"),
        (lambda mass, com, inertia: (mass, com, inertia * np.diag([100.0, 1.0, 1.0])), [4], "one moment of inertia"),
        (lambda mass, com, inertia: (mass, com, 0.05 * np.eye(3)), EVERY_BODY, "moments of inertia of 0.05 kg m^2"),
    ],
)
def test_a_file_with_masses_or_inertias_of_no_body_is_named_and_no_mistake_of_the_log(
    change: Callable[[float, Array, Array], tuple[float, Array, Array]], bodies: Sequence[int], fault: str
) -> None:
    checked = check(arm().log, damaged(change, *bodies), (), 10.0)
    assert [one.name for one in checked.findings if one.severity != NOTE] == ["inertials"]
    (finding,) = found(checked, "inertials", "robot")
    assert fault in finding.found
    assert set(finding.channels) >= {robot_of(ARM).bodies[body].name for body in bodies if body}


def test_a_mistake_of_the_log_is_named_beside_a_file_with_a_lost_decimal_point() -> None:
    robot = damaged(lambda mass, com, inertia: (100.0 * mass, com, inertia), 4)
    checked = check(scaled(arm().log, "joint_torque", -1.0), robot, (), 10.0)
    assert {one.name for one in checked.findings if one.severity != NOTE} >= {EXPLAINED}
    assert found(checked, "inertials", "robot")


def test_a_joint_that_pushes_against_its_limit_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    position = arm().log.joint_position[:, 1]
    limit = float(np.percentile(position, 85.0))
    limits = {arm().log.joint_names[1]: (float(position.min()) - 1.0, limit)}
    monkeypatch.setattr("torchid.log_checks.unknowns.position_limits", lambda _: limits)
    pushes = 30.0 * (position > limit)  # [N m]
    finding = only(of_arm(torques(arm().log, lambda torque: torque[:, 1].__iadd__(pushes))), "stop", "joint_position")
    assert finding.channels == (arm().log.joint_names[1],)
    stated = value(re.search(r"with (\S+) \+-", finding.found))
    assert float(stated[1]) == pytest.approx(30.0, rel=0.3)


@ELSEWHERE
def test_torques_that_armature_and_friction_make_up_have_no_factor() -> None:
    """Chirps by a PD law of a quadruped that hangs with its base held: rotors outweigh its legs."""
    urdf = ROBOTS / "go2_description" / "urdf" / "go2.urdf"
    for one in check_experiment(CONFIGS / "go2_in_air.yaml", [f"robot.urdf={urdf}"]):
        assert alarms(one) == []


# -------------------------------------------------------------------------------------------- offsets, exchanges, zeros


@pytest.mark.parametrize(("recorded", "share"), each_once([("arm", "contacts"), WALKER], [0.5, -0.8]))
def test_a_torque_that_is_off_by_a_constant_is_named_with_its_size(recorded: tuple[str, str], share: float) -> None:
    case = case_of(MACHINES[recorded[0]], recorded[1])
    offset = share * float(np.sqrt(np.square(value(case.log.joint_torque)).mean()))
    log = torques(case.log, lambda torque: torque[:, 1].__iadd__(offset))
    finding = only(checked(case, log), "offset", "joint_torque")
    stated = value(re.match(r"(\S+): torques read ([\d.]+) \+- ([\d.]+) N m too (much|little)", finding.found))
    assert (stated[1], stated[4]) == (case.log.joint_names[1], "much" if share > 0.0 else "little")
    assert float(stated[2]) == pytest.approx(abs(offset), abs=max(3.0 * float(stated[3]), 0.1 * abs(offset)))
    assert "sensors.offsets: {joint_torque: log}" in finding.advice


def test_offsets_of_all_torques_are_named_though_gravity_hides_one_of_them_at_times() -> None:
    rms = float(np.sqrt(np.square(value(arm().log.joint_torque)).mean()))
    offsets = rms * np.random.default_rng(1).normal(size=len(arm().log.joint_names))
    finding = only(of_arm(torques(arm().log, lambda torque: torque.__iadd__(offsets))), "offset", "joint_torque")
    assert len(finding.channels) >= len(offsets) - 2


@pytest.mark.parametrize("pair", study_but([(1, 2), (0, 6), (4, 5)], [(1, 2), (0, 6), (4, 5), (2, 3), (5, 6)]))
def test_torques_of_any_two_joints_that_are_exchanged_are_named(pair: tuple[int, int]) -> None:
    """Of wrists, too, whose torques are a hundredth of the shoulder's."""
    order = list(range(len(arm().log.joint_names)))
    order[pair[0]], order[pair[1]] = pair[1], pair[0]
    finding = only(of_arm(replace(arm().log, joint_torque=value(arm().log.joint_torque)[:, order])), EXPLAINED)
    assert (finding.severity, finding.field) == (REJECTED, "joint_torque")
    assert finding.channels == tuple(f"panda_joint{1 + joint}" for joint in pair)


@pytest.mark.parametrize("parts", study_but([("front", "rear")], [("left", "right"), ("front", "rear")]))
def test_torques_of_exchanged_legs_are_named(parts: tuple[str, str]) -> None:
    log, names = demo_log().select(slice(0, 600)), list(demo_log().joint_names)
    one, other = parts
    order = [names.index(name.replace(one, "?").replace(other, one).replace("?", other)) for name in names]
    explained = only(of_demo(replace(log, joint_torque=value(log.joint_torque)[:, order])), EXPLAINED)
    assert (explained.severity, explained.field) == (REJECTED, "joint_torque")
    assert explained.found.startswith(f"{' and '.join(parts)} exchanged")


def moved(joint: int, by: float) -> Log:
    return changed(arm().log, "joint_position", lambda q: q[:, joint].__iadd__(by))


@pytest.mark.parametrize(("joint", "by"), each_once([1, 3], [0.2, -0.4]))
def test_an_encoder_that_counts_from_another_zero_is_named_with_its_offset(joint: int, by: float) -> None:
    finding = only(of_arm(moved(joint, by)), "zero", "joint_position")
    assert (finding.severity, finding.channels) == (SUSPICIOUS, (arm().log.joint_names[joint],))
    stated = value(re.search(r"read ([\d.]+) \+- ([\d.]+) rad too (much|little)", finding.found))
    assert float(stated[1]) == pytest.approx(abs(by), abs=max(3.0 * float(stated[2]), 0.02))
    assert stated[3] == ("much" if by > 0.0 else "little")


@pytest.mark.parametrize(
    ("joint", "degrees"), [(1, 90), pytest.param(3, -90, marks=STUDY), pytest.param(1, 180, marks=STUDY)]
)
def test_an_encoder_that_counts_from_another_right_angle_is_named(joint: int, degrees: int) -> None:
    findings = of_arm(moved(joint, -np.radians(degrees))).findings
    assert [one for one in findings if arm().log.joint_names[joint] in one.found and one.field == "joint_position"]


@pytest.mark.parametrize(("joint", "with_torque"), [(0, False), (3, True)])
def test_a_joint_that_is_counted_the_other_way_is_named_and_whether_its_torque_is_too(
    joint: int, with_torque: bool
) -> None:
    log = arm().log
    sign = np.where(np.arange(len(log.joint_names)) == joint, -1.0, 1.0)
    torque = value(log.joint_torque) * (sign if with_torque else 1.0)
    finding = only(of_arm(replace(log, joint_position=log.joint_position * sign, joint_torque=torque)), EXPLAINED)
    assert (finding.severity, finding.field) == (REJECTED, "joint_position")
    assert finding.found.startswith(f"{log.joint_names[joint]} reversed{', with its torque' * with_torque}:")


def gravity_torque(direction: Sequence[float] = (0.0, 0.0, -9.81)) -> Array:
    """What gravity along a direction needs of the arm's URDF, by Pinocchio."""
    oracle = Oracle.of(robot_of(ARM))
    oracle.model.gravity.linear = np.array(direction)
    rest = np.zeros_like(arm().log.joint_position)
    return oracle.forces(arm().log.joint_position, rest, rest)


def test_torques_that_a_controller_has_freed_of_gravity_are_named() -> None:
    finding = only(of_arm(torques(arm().log, lambda torque: torque.__isub__(gravity_torque()))), "gravity")
    assert (finding.severity, finding.field) == (REJECTED, "joint_torque")
    share = value(re.match(r"torques lack (\d+) \+- (\d+) % of gravity", finding.found))
    assert float(share[1]) == pytest.approx(100.0, abs=max(3.0 * float(share[2]), 5.0))


def slanting(degrees: float, axis: str) -> Log:
    down = Rotation.from_euler(axis, degrees, degrees=True).apply([0.0, 0.0, -9.81])
    return torques(arm().log, lambda torque: torque.__iadd__(gravity_torque(down) - gravity_torque()))


def test_an_arm_on_a_table_that_slants_or_on_a_wall_is_told_so() -> None:
    finding = only(of_arm(slanting(12.0, "y")), "tilt", "base")
    assert re.match(r"gravity is 1[0-4].* about the base's own x and y axes", finding.found)
    wall = only(of_arm(slanting(90.0, "x")), EXPLAINED, "base")
    assert wall.found.startswith("mounted on a wall")
    assert re.match(r"set robot.base_tilt: \[-?1.5708, -?0.0000\]", wall.advice)


@pytest.mark.filterwarnings("ignore:.*these accelerations are largely noise")
@pytest.mark.parametrize(("degrees", "told"), [(12.0, True), pytest.param(0.0, False, marks=STUDY)])
def test_identify_says_that_the_table_of_an_arm_slants(
    tmp_path: object, degrees: float, told: bool, recwarn: pytest.WarningsRecorder
) -> None:
    write_log(slanting(degrees, "y"), f"{tmp_path}/arm.npz")
    with open(f"{tmp_path}/arm.yaml", "w") as file:
        file.write(
            f"robot: {{urdf: {ARM.urdf}, fixed_base: true}}\nlogs: [arm.npz]\npreprocessing: {{cutoff_hz: 10}}\n"
            f"sensors: joints\nestimator: {{name: least_squares, ridge: 1e-4}}\noutput: {tmp_path}/run\n"
        )
    identify(load_config(f"{tmp_path}/arm.yaml"))
    said = [str(one.message) for one in recwarn if "robot.base_tilt" in str(one.message)]
    assert bool(said) is told


def test_a_tool_that_the_urdf_lacks_is_not_taken_for_another_unit_of_time() -> None:
    robot, mass, height = robot_of(ARM), 6.0, 0.1
    tool = np.zeros((len(robot.bodies), 12))
    tool[robot.links["panda_hand"][0], [0, 3, 4, 7]] = mass * np.array([1.0, height, height**2, height**2])
    motion = (torch.from_numpy(x) for x in (arm().happened.q, arm().happened.v, arm().happened.a))
    carried = (Regressor(robot)(*motion) @ torch.from_numpy(tool.flatten())).numpy()
    assert "time" not in [one.field for one in of_arm(torques(arm().log, lambda x: x.__iadd__(carried))).findings]


# ---------------------------------------------------------------------------------------- lags, worlds, contact sensors


@pytest.mark.parametrize(
    ("recorded", "seconds"), each_once([("arm", "contacts"), WALKER, ("biped", "joints")], [0.1, -0.06])
)
def test_torques_that_are_late_or_early_are_named_with_the_time(recorded: tuple[str, str], seconds: float) -> None:
    case = case_of(MACHINES[recorded[0]], recorded[1])
    finding = only(checked(case, with_delayed_torques(case.log, seconds)), "delay", "joint_torque")
    stated = value(re.match(r"torques are ([\d.]+) \+- ([\d.]+) ms (later|earlier)", finding.found))
    late = float(stated[1]) * (1.0 if stated[3] == "later" else -1.0)
    assert late == pytest.approx(1e3 * seconds + 5.0, abs=8.0)  # filters of sensors are late by 10 ms
    shift = value(re.search(r"actuators.delay: (-?[\d.]+)$", finding.advice))
    assert float(shift[1]) == pytest.approx(-1e-3 * late, rel=0.06)


@pytest.mark.parametrize(
    ("late", "field"),
    [
        ("contact forces", "contact_wrench_local"),
        pytest.param("the joints' motion", "joint_position", marks=STUDY),
    ],
)
def test_of_torques_forces_and_motion_the_one_that_the_others_contradict_is_late(late: str, field: str) -> None:
    case = case_of(MACHINES["biped"], "full")
    moved = dict.fromkeys(("contact_wrench_local", "contact_active") if "contact" in late else (field,), slice(None))
    finding = only(checked(case, with_delayed(case.log, 0.03, moved)), "delay")
    assert finding.field == field
    stated = value(re.match(rf"{late} (?:are|is) ([\d.]+) \+- [\d.]+ ms later", finding.found))
    assert float(stated[1]) == pytest.approx(30.0, abs=6.0)


def tilted(log: Log, rotvec_deg: Sequence[float]) -> Log:
    """The same motion as told in a world that is turned."""
    R = Rotation.from_rotvec(np.radians(rotvec_deg))
    place = log.base_position_world
    turned = None if place is None else R.apply(place)
    quat = (R * Rotation.from_quat(value(log.base_quat_xyzw))).as_quat()
    return replace(
        log, base_quat_xyzw=quat, base_position_world=turned, base_linear_velocity_world=None,
        base_linear_acceleration_world=None,
    )  # fmt: skip


def test_a_world_that_is_tilted_is_named_with_the_angles() -> None:
    finding = only(of_demo(tilted(demo_log(), [9.6, -7.2, 0.0])), "tilt", "base_quat_xyzw")
    stated = value(
        re.match(r"gravity is \S+ degrees from down \(([-\d.]+) and ([-\d.]+) about the world", finding.found)
    )
    np.testing.assert_allclose([float(stated[1]), float(stated[2])], [9.6, -7.2], rtol=0.0, atol=2.0)
    assert "base_tilt: auto" in finding.advice


def test_a_world_whose_z_axis_is_level_is_named_with_the_axis_that_points_up() -> None:
    finding = only(of_demo(tilted(demo_log(), [-90.0, 0.0, 0.0])), EXPLAINED, "base_quat_xyzw")
    assert finding.found.startswith("in a world whose y axis points up")
    case = case_of(MACHINES["quadruped"], "joints")
    seen = only(checked(case, tilted(case.log, [0.0, 90.0, 0.0])), "gravity", "base_quat_xyzw")
    assert seen.found.endswith("Does the world's x axis point up?")


@pytest.mark.parametrize(
    ("change", "name", "text"),
    [
        (-np.eye(3), "sign", "fits best with a factor of -"),
        (1.6 * np.eye(3), "scale", "fits best with a factor of 0.6"),
        (Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix(), "frame", "turned by [23]"),
    ],
    ids=["sign", "gain", "turn"],
)
def test_the_one_contact_sensor_that_is_reversed_scaled_or_turned_is_named(change: Array, name: str, text: str) -> None:
    case = case_of(MACHINES[WALKER[0]], WALKER[1])
    wrench = value(case.log.contact_wrench_local).copy()
    wrench[:, 1] = wrench[:, 1] @ np.kron(np.eye(2), change.T)
    findings = checked(case, replace(case.log, contact_wrench_local=wrench)).findings
    (finding,) = (one for one in findings if one.name == name and one.severity == SUSPICIOUS)
    assert (finding.field, finding.channels) == ("contact_wrench_local", (case.log.contact_names[1],))
    assert re.search(text, finding.found)


def rolled(log: Log) -> Log:
    return replace(log, base_quat_xyzw=np.roll(value(log.base_quat_xyzw), 1, axis=1))


def inverted(log: Log) -> Log:
    return replace(log, base_quat_xyzw=Rotation.from_quat(value(log.base_quat_xyzw)).inv().as_quat())


@pytest.mark.parametrize(
    ("mistake", "field", "text"),
    [
        (lambda log: scaled(log, "contact_wrench_local", 1e-3), "contact_wrench_local", "in kN"),
        (lambda log: scaled(log, "contact_wrench_local", 1.0 / 9.81), "contact_wrench_local", "in kg"),
        (lambda log: scaled(log, "contact_wrench_local", -1.0), "contact_wrench_local", "all reversed"),
        (rolled, "base_quat_xyzw", "wrong order: w first and w last are confused"),
        (inverted, "base_quat_xyzw", "rotates world to base"),
    ],
    ids=["kN", "kg", "wrenches reversed", "order", "inverse"],
)
def test_a_usual_mistake_is_named_by_what_it_explains(mistake: Callable[[Log], Log], field: str, text: str) -> None:
    found_ = of_demo(mistake(demo_log().select(slice(0, 600))))
    explained = only(found_, EXPLAINED)
    assert (explained.severity, explained.field) == (REJECTED, field)
    assert explained.found.startswith(text)
    assert not found_.usable


# -------------------------------------------------------------------------------------------------------- dead encoders


def dead(log: Log, joint: int, noise: float = 0.0) -> Log:
    """The log with a joint's encoder stuck at its first reading, with noise."""
    stuck = log.joint_position[0, joint] + noise * np.random.default_rng(1).normal(size=len(log))
    return changed(log, "joint_position", lambda q: q.__setitem__((slice(None), joint), stuck))


def test_joints_that_never_move_are_told_from_those_that_hardly_do() -> None:
    log = demo_log()
    assert still_joints(log) == ()
    for noise in (0.0, 1e-4):
        assert still_joints(dead(log, 5, noise)) == (log.joint_names[5],)
    slow = changed(dead(log, 5), "joint_position", lambda q: q[:, 5].__iadd__(2e-3 * np.sin(log.time)))
    assert still_joints(slow) == ()


def test_a_dead_encoder_is_named_by_its_foot_its_torque_or_its_velocity() -> None:
    log, rng = demo_log(), np.random.default_rng(0)
    knee = next(i for i, name in enumerate(log.joint_names) if "knee" in name)
    foot = only(of_demo(dead(log, knee, 1e-4)), "standing feet", "joint_position")
    assert f". {log.joint_names[knee]} in its limb never moves: is its encoder dead?" in foot.found
    loaded = only(of_arm(dead(arm().log, 1)), "dead encoder", "joint_position")
    assert (loaded.severity, loaded.channels) == (SUSPICIOUS, (arm().log.joint_names[1],))
    rate = np.gradient(log.joint_position, log.time, axis=0) + 0.02 * rng.normal(size=log.joint_position.shape)
    assert list(check_still_velocities(replace(log, joint_velocity=rate))) == []
    [moves] = check_still_velocities(replace(dead(log, 4), joint_velocity=rate))
    assert (moves.name, moves.severity, moves.channels) == ("dead encoder", SUSPICIOUS, (log.joint_names[4],))


def test_what_no_usual_mistake_explains_is_only_suspicious() -> None:
    torque = value(arm().log.joint_torque)
    finding = only(of_arm(replace(arm().log, joint_torque=np.roll(torque, 600, axis=0))), "forces")
    assert finding.severity == SUSPICIOUS
    assert "no usual mistake" in finding.found


def test_forces_that_nobody_measured_and_torques_that_are_all_zero_say_nothing() -> None:
    log = demo_log()
    torque, wrench = (np.full_like(value(x), np.nan) for x in (log.joint_torque, log.contact_wrench_local))
    of_nothing = of_demo(replace(log, joint_torque=torque, contact_wrench_local=wrench))
    assert not found(of_nothing, "offset")
    zero = of_arm(torques(arm().log, lambda x: x.__imul__(0.0)))
    assert zero.usable
    assert not found(zero, "unit", "time")


def test_values_of_uninitialised_memory_are_rejected_where_they_are() -> None:
    case = case_of(MACHINES["biped"], "full")
    spiky = torques(case.log, lambda torque: torque.__setitem__((600, 1), 1e12) or torque.__setitem__((900, 0), -3e12))
    assert {"absurd", "spike"} & {one.name for one in checked(case, spiky).findings if one.severity == REJECTED}


def test_a_floating_base_that_nothing_holds_is_asked_for_its_contacts() -> None:
    bare = replace(demo_log(), contact_names=(), contact_active=None, contact_wrench_local=None)
    assert "list under contacts" in only(check(bare, demo_robot(), (), 8.0), "forces").advice


def test_a_log_of_another_robot_is_not_usable_and_one_without_a_robot_says_what_was_not_checked() -> None:
    log = arm().log
    renamed = check(replace(log, joint_names=tuple(f"x_{name}" for name in log.joint_names)), robot_of(ARM))
    finding = only(renamed, "does not fit")
    assert isinstance(finding, Finding)
    assert finding.field == "joint_names"
    assert not renamed.usable
    feet = [Contact(name, "point") for name in demo_log().contact_names[:3]]
    assert (
        "active, but not a contact of the experiment"
        in only(check(demo_log(), demo_robot(), feet, 8.0), "does not fit").found
    )
    reasons = {skip.name: skip.reason for skip in check(log).skipped}
    assert "no robot" in reasons["forces against the model"]
