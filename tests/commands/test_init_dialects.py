"""`torchid init` of recordings whose programs have habits of their own: what is found, and what is said of the rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dialects import save_csv
from scipy.spatial.transform import Rotation
from synthetic import ANYMAL, PANDA, ROBOTS, SOLO12

from torchid.commands.check import recorded_segments
from torchid.commands.init import InitReport, init
from torchid.config import load_config
from torchid.errors import LogError, TorchidWarning
from torchid.logs import Log, read_log
from torchid.proposals.numbers import point_along_z, threshold

GO1, HYQ = ROBOTS / "go1_description/urdf/go1.urdf", ROBOTS / "hyq_description/robots/hyq_no_sensors.urdf"
UR5 = ROBOTS / "ur_description/urdf/ur5_robot.urdf"
UNITREE = [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")]
TIME = 0.005 * np.arange(200)
pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")  # of URDFs


def motion(joints: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and torques (N, joints)."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(2.0, 6.0, joints), rng.uniform(0.0, 6.0, joints)
    turn = np.outer(TIME, rate) + phase
    return 0.4 * np.sin(turn), 0.4 * rate * np.cos(turn), rng.normal(size=(len(TIME), joints))


def started(urdf: Path, log: Path) -> tuple[InitReport, Log, dict[str, Any]]:
    """What init said, the log as it is read with what it wrote, and the map."""
    target = log.with_suffix(".yaml")
    said = init(urdf, log, target)
    config = load_config(target)
    assert config.logs is not None
    assert config.logs.columns is not None
    settings = config.preprocessing
    read = read_log(log, columns=config.logs.columns, allow_gaps=True, needs_flags=settings.needs_flags)
    given = {name: x for name, x in vars(config.logs.columns).items() if x}
    return said, read, given


def in_order(log: Log, names: list[str]) -> np.ndarray:
    return log.joint_position[:, [log.joint_names.index(name) for name in names]]


def test_joints_by_limb_and_number_are_counted_from_the_base_outwards(tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    columns: dict[str, Any] = {"": np.arange(len(TIME)), "stamp_ns": (TIME * 1e9).astype(int)}
    for number in range(12):
        leg = UNITREE[number][:2]
        for what, x in (("q", q), ("dq", dq), ("tauEst", tau)):
            columns[f"{leg}_{number % 3}_{what}"] = x[:, number]
    said, log, _ = started(GO1, save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_array_equal(in_order(log, UNITREE), q)
    assert log.joint_velocity is not None
    assert log.joint_torque is not None
    assert "joint_position: joints by their limb and number, counted from the base outwards" in said.guessed
    np.testing.assert_allclose(log.time, TIME, atol=1e-12)


def test_names_of_the_sl_simulator_are_known(tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    joints = [f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE")]
    columns: dict[str, Any] = {"time": TIME}
    for number, name in enumerate(joints):
        columns |= {f"{name}_th": q[:, number], f"{name}_thd": dq[:, number], f"{name}_load": tau[:, number]}
        columns |= {f"{name}_des_th": 1.1 * q[:, number], f"{name}_uff": tau[:, number]}
    columns |= {f"base_q{k}": np.full(len(TIME), float(k == 0)) for k in range(4)}
    columns |= {f"base_{axis}": 0.1 * np.sin(TIME) for axis in "xyz"}
    _, log, _ = started(HYQ, save_csv(tmp_path / "x.csv", columns, "\t"))
    np.testing.assert_array_equal(in_order(log, [f"{name.lower()}_joint" for name in joints]), q)
    assert log.joint_velocity is not None
    assert log.joint_torque is not None
    assert log.base_position_world is not None
    np.testing.assert_array_equal(log.base_quat_xyzw, np.tile([0.0, 0.0, 0.0, 1.0], (len(TIME), 1)))


def test_an_axis_inside_of_a_name_and_stamps_as_dates_are_found(tmp_path: Path) -> None:
    q, _, tau = motion(6)
    names = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint"]
    names.append("wrist_3_joint")
    path = tmp_path / "x.csv"
    stamps = [f"2024-03-01 09:30:{x:09.6f}" for x in TIME]
    values: dict[str, Any] = {"timestamp": stamps}
    for k, name in enumerate(names):
        values |= {f"Device/{name}/Position/Sensor/Value": q[:, k], f"Device/{name}/Torque/Sensor/Value": tau[:, k]}
    values |= {f"Device/Inertial/Accelerometer{x}/Sensor/Value": np.full(len(TIME), 9.81 * (x == "Z")) for x in "XYZ"}
    values |= {f"Device/Inertial/Gyroscope{x}/Sensor/Value": np.zeros(len(TIME)) for x in "XYZ"}
    rows = zip(*(np.asarray(x).tolist() for x in values.values()), strict=True)
    path.write_text("\n".join([",".join(values), *(",".join(map(str, row)) for row in rows)]) + "\n")
    _, log, _ = started(UR5, path)
    np.testing.assert_array_equal(in_order(log, names), q)
    assert log.imu_specific_force is not None
    np.testing.assert_allclose(log.imu_specific_force.mean(axis=0), [0.0, 0.0, 9.81])
    np.testing.assert_allclose(log.time - log.time[0], TIME, atol=1e-6)


def test_numbers_of_some_joints_are_those_whose_names_have_numbers(tmp_path: Path) -> None:
    q, dq, tau = motion(7)
    columns: dict[str, Any] = {"time": 1e3 * TIME}
    for what, x in (("tau_J", tau), ("q", q), ("q_d", 1.1 * q), ("dq", dq), ("tau_ext_hat_filtered", 0.1 * tau)):
        columns |= {f"{what}[{k}]": x[:, k] for k in range(7)}
    said, log, given = started(PANDA, save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_array_equal(in_order(log, [f"panda_joint{k}" for k in range(1, 8)]), q)
    np.testing.assert_allclose(log.time, TIME, atol=1e-12)
    np.testing.assert_array_equal(log.joint_torque, tau)
    assert given["time"].unit == {"*": "ms"}
    assert any("robot.weld" in text and "panda_finger_joint1" in text for text in said.guessed)


def test_angles_that_jump_by_a_turn_are_unwrapped(tmp_path: Path) -> None:
    q, dq, tau = motion(6)
    columns: dict[str, Any] = {"t": TIME}
    for k in range(6):
        columns |= {f"actuators.{k}.position": np.mod(np.degrees(q[:, k]), 360.0)}
        columns |= {f"actuators.{k}.velocity": np.degrees(dq[:, k]), f"actuators.{k}.torque": tau[:, k]}
    _, log, given = started(UR5, save_csv(tmp_path / "x.csv", columns))
    np.testing.assert_allclose(log.joint_position, q, atol=1e-12)
    np.testing.assert_allclose(log.joint_velocity, dq, atol=1e-12)
    assert given["joint_position"].turn_from == {"*": -180.0}


def test_arrays_of_simulators_are_split(tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    rng, count = np.random.default_rng(1), len(TIME)
    quat = np.tile([0.0, 0.1, 0.0, np.sqrt(0.99)], (count, 1))
    forces = np.zeros((count, 4, 3))
    forces[..., 2] = 30.0 + rng.normal(size=(count, 4))
    arrays = {
        "time": TIME, "dof_pos": q, "dof_vel": dq, "torques": tau, "contact_forces": forces,
        "root_states": np.hstack([rng.normal(size=(count, 3)), quat, rng.normal(size=(count, 6))]),
    }  # fmt: skip
    np.savez(tmp_path / "isaac.npz", **arrays)
    _, log, given = started(GO1, tmp_path / "isaac.npz")
    np.testing.assert_array_equal(log.base_position_world, arrays["root_states"][:, :3])
    np.testing.assert_allclose(log.base_quat_xyzw, quat)
    assert given["contact_wrench_world"].force.column == "contact_forces", "forces in the world point up"
    qpos = np.hstack([arrays["root_states"][:, :3], np.roll(quat, 1, axis=1), q])
    qvel = np.hstack([np.zeros((count, 6)), dq])
    np.savez(tmp_path / "mujoco.npz", time=TIME, qpos=qpos, qvel=qvel, qfrc=np.hstack([np.zeros((count, 6)), tau]))
    said, log, given = started(GO1, tmp_path / "mujoco.npz")
    np.testing.assert_array_equal(log.joint_position, q)
    np.testing.assert_array_equal(log.joint_velocity, dq)
    np.testing.assert_array_equal(log.joint_torque, tau)
    np.testing.assert_allclose(log.base_quat_xyzw, quat)
    assert "joint_position: columns 7 to the last of 'qpos'" in said.guessed


@pytest.mark.parametrize("has_base", [True, False])
def test_states_of_optimal_control_are_positions_then_velocities_and_one_more_than_controls(
    tmp_path: Path, has_base: bool
) -> None:
    q, dq, tau = motion(12 if has_base else 6)
    turn = Rotation.from_rotvec(np.outer(np.sin(TIME), [0.1, 0.2, 0.3]))
    rate = turn.apply(np.outer(np.cos(TIME), [0.1, 0.2, 0.3]), inverse=True)
    place, speed = np.outer(np.sin(2.0 * TIME), [0.1, 0.2, 0.0]), np.outer(2.0 * np.cos(2.0 * TIME), [0.1, 0.2, 0.0])
    xs = [q, dq]
    if has_base:
        xs = [place, turn.as_quat(), q, turn.apply(speed, inverse=True), rate, dq]
    np.savez(tmp_path / "x.npz", xs=np.hstack(xs), us=tau[:-1], dt=TIME[1] - TIME[0])
    with pytest.warns(TorchidWarning, match="joint_torque has one sample less than all else, as controls have"):
        _, log, _ = started(GO1 if has_base else UR5, tmp_path / "x.npz")
    for name, values in (("joint_position", q[:-1]), ("joint_velocity", dq[:-1]), ("joint_torque", tau[:-1])):
        np.testing.assert_array_equal(getattr(log, name), values)
    if has_base:
        np.testing.assert_allclose(log.base_angular_velocity_base, rate[:-1])
        np.testing.assert_allclose(log.base_linear_velocity_world, speed[:-1], atol=1e-12)


@pytest.mark.parametrize("name", ["dt", "step_dt", "sim_time_step", "duration"])
@pytest.mark.parametrize("each", [False, True], ids=["once", "of each sample"])
def test_a_number_called_dt_is_the_step_of_a_recording_without_stamps(tmp_path: Path, name: str, each: bool) -> None:
    q, dq, tau = motion(12)
    arrays = {"dof_pos": q, "dof_vel": dq, "torques": tau, "actions": q, name: np.full(len(q) if each else (), 0.005)}
    np.savez(tmp_path / "x.npz", **arrays)
    said, log, given = started(GO1, tmp_path / "x.npz")
    np.testing.assert_array_equal(log.time, TIME)
    assert given["time"].step == 0.005
    assert f"time: steps of '{name}' [s], as nothing has stamps" in said.guessed
    assert not any(text.startswith("time") for text in said.missing)


def test_an_angular_velocity_in_degrees_is_known_by_how_gravity_turns(tmp_path: Path) -> None:
    q, _, tau = motion(12)
    tilt = 0.2 * np.sin(3.0 * TIME)
    force = 9.81 * np.stack([-np.sin(tilt), 0.0 * tilt, np.cos(tilt)], axis=1)  # turned about y
    rate = np.stack([0.0 * tilt, 0.6 * np.cos(3.0 * TIME), 0.0 * tilt], axis=1)
    for name, factor in (("rad", 1.0), ("deg", 180.0 / np.pi)):
        np.savez(tmp_path / f"{name}.npz", t=TIME, q=q, tau=tau, imu_acc=force, imu_gyro=factor * rate)
        _, log, _ = started(SOLO12, tmp_path / f"{name}.npz")
        np.testing.assert_allclose(log.imu_angular_velocity, rate, atol=1e-12)


def test_stamps_are_those_that_increase_and_lie_beside_the_positions(tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    arrays = {"loop_t": np.full(len(TIME), 0.001), "tstamps": TIME, "q_mes": q, "v_mes": dq, "torques": tau}
    np.savez(tmp_path / "x.npz", **arrays)
    _, log, given = started(SOLO12, tmp_path / "x.npz")
    assert given["time"].column == "tstamps"
    assert log.joint_velocity is not None
    with h5py.File(tmp_path / "y.h5", "w") as file:
        file["imu/acc/data"], file["imu/acc/timestamps"] = np.zeros((40, 3)), np.arange(40.0)
        file["joints/positions/data"], file["joints/positions/timestamps"] = q[:, None], TIME
        file["joints/torques/data"], file["joints/torques/timestamps"] = tau[:, None], TIME
    _, log, given = started(SOLO12, tmp_path / "y.h5")
    assert given["time"].column == "joints/positions/timestamps"
    np.testing.assert_array_equal(log.joint_position, q)


def test_an_accelerometer_goes_with_the_angular_velocity_of_the_base_and_an_imu_is_no_base(tmp_path: Path) -> None:
    q, _, tau = motion(12)
    still = np.tile([0.0, 0.0, 9.81], (len(TIME), 1))
    arrays = {"t": TIME, "q": q, "tau": tau, "baseAccelerometer": still, "baseAngularVelocity": 0.0 * still}
    np.savez(tmp_path / "x.npz", **arrays)
    _, log, _ = started(SOLO12, tmp_path / "x.npz")
    np.testing.assert_array_equal(log.imu_specific_force, still)
    columns: dict[str, Any] = {"time": TIME}
    columns |= {f"linear_acceleration_base_imu_{axis}": x for axis, x in zip("xyz", still.T, strict=True)}
    columns |= {f"angular_velocity_base_imu_{axis}": 0.0 * TIME for axis in "xyz"}
    columns |= {f"q_{k}": q[:, k] for k in range(12)} | {f"tau_{k}": tau[:, k] for k in range(12)}
    _, log, given = started(SOLO12, save_csv(tmp_path / "imu.csv", columns))
    np.testing.assert_array_equal(log.imu_specific_force, still)
    assert "base_linear_acceleration_base" not in given, "it has gravity"


def test_short_gaps_in_the_motion_are_bridged_and_long_ones_excluded(tmp_path: Path) -> None:
    q, _, tau = motion(12)
    for last, key in ((103, "bridge_gaps_s: 0.05"), (150, "exclude_rejected: true")):
        gappy = q.copy()
        gappy[100:last, 3] = np.nan
        np.savez(tmp_path / f"{last}.npz", t=TIME, q=gappy, tau=tau)
        said, *_ = started(SOLO12, tmp_path / f"{last}.npz")
        assert key in (tmp_path / f"{last}.yaml").read_text()
        assert any(text.startswith("preprocessing.") and "gaps of joint_position" in text for text in said.guessed)


def test_of_a_long_log_a_fit_takes_as_few_samples_as_the_filter_allows(tmp_path: Path) -> None:
    for count in (100_000, 100_001):
        time = np.arange(count) / 500.0
        swing = 0.3 * np.sin(time[:, None] + np.arange(12))
        np.savez(tmp_path / f"{count}.npz", t=time, q=swing, tau=swing)
        said, *_ = started(SOLO12, tmp_path / f"{count}.npz")
        is_long = count > 100_000
        assert ("sample_rate_hz: auto" in (tmp_path / f"{count}.yaml").read_text()) == is_long
        assert any("preprocessing.sample_rate_hz: auto, as 100001 samples" in text for text in said.guessed) == is_long


RPY = np.stack([0.2 * np.sin(TIME), 0.1 - 0.3 * TIME, 3.0 + 0.4 * TIME], axis=1)  # yaw passes half a turn


@pytest.mark.parametrize(
    ("names", "factor"),
    [
        (["roll", "pitch", "yaw"], 1.0),
        (["Rumpf.Rot.Roll", "Rumpf.Rot.Nick", "Rumpf.Rot.Gier"], 1.0),
        (["imu_roll_deg", "imu_pitch_deg", "imu_yaw_deg"], 180.0 / np.pi),
        (["base_rpy_0", "base_rpy_1", "base_rpy_2"], 1.0),
        (["euler.x [deg]", "euler.y [deg]", "euler.z [deg]"], 180.0 / np.pi),
        (["Attitude Roll", "Attitude Pitch", "Attitude Yaw"], 180.0 / np.pi),
    ],
)
def test_angles_of_the_base_are_its_orientation(names: list[str], factor: float, tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    columns: dict[str, Any] = {"t": TIME}
    for what, x in (("q", q), ("dq", dq), ("tau", tau)):
        columns |= {f"{what}_{k}": x[:, k] for k in range(12)}
    columns |= {name: factor * x for name, x in zip(names, RPY.T, strict=True)}
    columns |= {"cmd_roll": TIME, "cmd_pitch": TIME, "cmd_yaw": TIME, "roll_rate": TIME, "pitch_rate": TIME}
    columns |= {"old_euler_x": TIME, "old_euler_y (deg)": TIME, "old_euler_z": TIME}
    _, log, _ = started(GO1, save_csv(tmp_path / "x.csv", columns))
    assert log.base_quat_xyzw is not None
    x, y, z = (Rotation.from_rotvec(np.outer(angle, axis)) for angle, axis in zip(RPY.T, np.eye(3), strict=True))
    off = (z * y * x).inv() * Rotation.from_quat(log.base_quat_xyzw)
    np.testing.assert_allclose(off.magnitude(), 0.0, atol=1e-10)


def test_angles_in_an_array_are_the_orientation_and_those_of_joints_are_not(tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    arrays = {"t": TIME, "q": q, "dq": dq, "tau": tau}
    np.savez(tmp_path / "x.npz", **arrays, imu_rpy=RPY, hip_roll=TIME, hip_pitch=TIME, hip_yaw=TIME)
    _, log, given = started(GO1, tmp_path / "x.npz")
    assert given["base_quat_wxyz"].rpy.column == "imu_rpy"
    expected = Rotation.from_euler("ZYX", RPY[:, ::-1])
    assert log.base_quat_xyzw is not None
    np.testing.assert_allclose((expected.inv() * Rotation.from_quat(log.base_quat_xyzw)).magnitude(), 0.0, atol=1e-10)
    np.savez(tmp_path / "y.npz", **arrays, hip_roll=TIME, hip_pitch=TIME, hip_yaw=TIME)
    assert started(GO1, tmp_path / "y.npz")[1].base_quat_xyzw is None


def test_what_columns_may_be_that_are_not_read_is_said(tmp_path: Path) -> None:
    q, dq, _ = motion(12)
    columns: dict[str, Any] = {"t": TIME, "dt": TIME}
    columns |= {f"leg_left_{k}_position": q[:, k] for k in range(6)}
    said = init(ANYMAL, save_csv(tmp_path / "other.csv", columns), tmp_path / "other.yaml")
    assert any("is it the one that was recorded?" in text for text in said.missing)
    columns = {f"q_{k}": q[:, k] for k in range(12)} | {f"current_{k}": dq[:, k] for k in range(12)}
    columns |= {"roll_deg": TIME, "pitch_deg": TIME, "left_ft_x": TIME}
    said = init(ANYMAL, save_csv(tmp_path / "lacks.csv", columns), tmp_path / "lacks.yaml")
    text = "\n".join(said.missing)
    for found in (
        "joint_torque: 'current_0' and 11 more may be currents of motors",
        "base_quat: 'roll_deg' and 1 more may be angles of the base; give all three as base_quat_wxyz: {rpy: ...}",
        "forces at the feet: 'left_ft_x' may be force/torque sensors",
        "time: no columns that look like it",
    ):
        assert found in text


def test_a_threshold_of_contact_is_as_low_as_readings_in_the_air_allow() -> None:
    rng = np.random.default_rng(0)
    air, load = 20.0 + rng.normal(0.0, 1.0, 500), 300.0 + rng.normal(0.0, 10.0, 500)
    quiet = threshold(np.concatenate([air, load])[:, None])
    assert 20.0 + 4.0 < quiet <= 40.0
    noisy = threshold(np.concatenate([20.0 + rng.normal(0.0, 6.0, 500), load])[:, None])
    assert quiet < noisy < 20.0 + 0.2 * 310.0
    assert threshold(np.full((5, 4), np.nan)) == 0.0


def test_forces_point_along_z_in_the_world_alone() -> None:
    up = np.tile([5.0, -3.0, 100.0], (10, 4, 1))
    tilted = np.tile([60.0, 0.0, 80.0], (10, 4, 1))
    assert point_along_z(up)
    assert point_along_z(-up), "those of the robot on the ground"
    assert not point_along_z(tilted)


def test_episodes_of_lists_are_recordings_of_which_the_last_is_held_back(tmp_path: Path) -> None:
    """As of LeRobot's Parquet: stamps begin anew in each episode."""
    q, _, tau = motion(8)
    lists = {
        f"observation.{name}": pa.array([x[k % len(TIME)] for k in range(3 * len(TIME))])
        for name, x in (("state", q), ("effort", tau))
    }
    episode = np.repeat(np.arange(3), len(TIME))
    pq.write_table(pa.table(lists | {"timestamp": np.tile(TIME, 3), "episode_index": episode}), tmp_path / "x.parquet")
    target = tmp_path / "x.yaml"
    said = init(PANDA, tmp_path / "x.parquet", target)
    logs = load_config(target).logs
    assert logs is not None
    assert [path.name for path in logs.train + logs.test] == [f"x.parquet[#{k}]" for k in range(3)]
    assert len(logs.test) == 1
    assert "logs: 3 recordings one after the other, as stamps begin anew; the last held back as test" in said.guessed
    for path in logs.train + logs.test:
        log = read_log(path, columns=logs.columns)
        np.testing.assert_array_equal(log.joint_position, q)
        np.testing.assert_array_equal(log.joint_torque, tau)


def test_arrays_with_stamps_of_their_own_are_interpolated_to_the_fastest(tmp_path: Path) -> None:
    q, dq, tau = motion(12)
    acc, gyro = (np.sin(3.0 * TIME[::4, None] + np.arange(3)) + offset for offset in ([0.0, 0.0, 9.8], [0.0] * 3))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        joints = {"stamp": TIME, "q": q, "dq": np.degrees(dq), "tau": tau}
        imu = {"stamp": 1e3 * TIME[::4], "acc": acc, "gyro": gyro}
        file.update({f"{of}/{name}": x for of, xs in (("joints", joints), ("imu", imu)) for name, x in xs.items()})
    said, log, given = started(SOLO12, tmp_path / "x.h5")
    assert [entry.column for entry in given["other_times"]] == ["imu/stamp"]
    assert not any("not read" in text for text in said.missing)
    np.testing.assert_allclose(log.time, TIME[: len(log)], atol=1e-12)
    np.testing.assert_array_equal(log.joint_position, q[: len(log)])
    assert log.joint_velocity is not None
    assert log.imu_angular_velocity is not None
    np.testing.assert_allclose(log.joint_velocity, dq[: len(log)], rtol=1e-12)
    np.testing.assert_allclose(log.imu_angular_velocity, np.sin(3.0 * log.time[:, None] + np.arange(3)), atol=1e-6)
    config = load_config(tmp_path / "x.yaml")
    assert config.logs is not None
    (segment,) = recorded_segments(tmp_path / "x.h5", config.logs, config.preprocessing)
    np.testing.assert_array_equal(segment.log.joint_position, log.joint_position)


def test_rows_of_joints_in_several_files_are_refused_in_one_line(tmp_path: Path) -> None:
    rows = [f"{t:.3f},{name},0.1" for t in TIME[:20] for name in ("FL_HAA", "FL_HFE", "FL_KFE")]
    for name in ("position", "effort"):
        (tmp_path / f"{name}.csv").write_text("\n".join([f"stamp,joint,{name}", *rows]) + "\n")
    with pytest.raises(LogError, match="position.csv: column 'joint': a row for each joint, in one of several files"):
        init(SOLO12, tmp_path / "position.csv + effort.csv", tmp_path / "x.yaml")
    assert not (tmp_path / "x.yaml").exists()
