"""`torchid init` of twelve robots from logs in many dialects: what is found has the numbers that were recorded."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from foreign_robots import DIALECTS, Motion, compared, moved, recorded_fields
from synthetic import G1, ROBOTS
from thinned import each_once

from torchid.commands.init import init
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.logs import read_log
from torchid.robot import load_robot

#: URDF, frames of feet, and link of the IMU ("" for the base link).
MACHINES = {
    "go2": ("go2_description/urdf/go2.urdf", ("FL_foot", "FR_foot", "RL_foot", "RR_foot"), "imu"),
    "g1": (str(G1), ("left_ankle_roll_link", "right_ankle_roll_link"), "imu_in_pelvis"),
    "anymal": ("anymal_c_simple_description/urdf/anymal.urdf", ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT"), ""),
    "hyq": ("hyq_description/robots/hyq_no_sensors.urdf", ("lf_foot", "rf_foot", "lh_foot", "rh_foot"), ""),
    "solo12": ("solo_description/robots/solo12.urdf", ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), ""),
    "bolt": ("bolt_description/robots/bolt.urdf", ("FL_FOOT", "FR_FOOT"), ""),
    "talos": ("talos_data/robots/talos_reduced.urdf", ("left_sole_link", "right_sole_link"), ""),
    "icub": ("icub_description/robots/icub_reduced.urdf", ("l_sole", "r_sole"), ""),
    "romeo": ("romeo_description/urdf/romeo_small.urdf", ("l_sole", "r_sole"), ""),
    "romeo with mixed names": ("romeo_description/urdf/romeo_laas_small.urdf", ("l_sole", "r_sole"), ""),
    "alexander": ("alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf", ("LEFT_FOOT", "RIGHT_FOOT"), ""),
    "panda": ("panda_description/urdf/panda.urdf", (), ""),
}  # fmt: skip
#: Guesses that nothing in the file could have told: a Go2's feet without names, in another order than its maker's.
WRONG = {("go2", "npz"): {"contact_active"}}
pytestmark = pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")  # of URDFs, frames, times of receipt


@cache
def motion_of(robot: str) -> Motion:
    urdf, feet, imu_frame = MACHINES[robot]
    loaded = load_robot(ROBOTS / urdf)
    return moved(loaded, feet, imu_frame or loaded.base_link, seed=3)


@pytest.mark.parametrize(("robot", "dialect"), each_once([*MACHINES], [*DIALECTS], rounds=2))
def test_all_that_was_recorded_is_found_with_its_numbers(tmp_path: Path, robot: str, dialect: str) -> None:
    urdf, feet, _ = MACHINES[robot]
    name, write, _ = DIALECTS[dialect]
    motion = motion_of(robot)
    path = write(tmp_path / name, motion)
    said = init(ROBOTS / urdf, path, tmp_path / "new.yaml")
    config = load_config(tmp_path / "new.yaml")
    set_up(config)
    found = compared(
        recorded_fields(motion.log, dialect),
        motion.log,
        read_log(path, config.logs.topics, columns=config.logs.columns),
    )
    assert {field for field, verdict in found.items() if verdict != "right"} == WRONG.get((robot, dialect), set())
    bodies = load_robot(ROBOTS / urdf).links
    assert {bodies[one.frame][0] for one in config.contacts} == {bodies[foot][0] for foot in feet}
    assert config.robot.fixed_base == (not feet)
    assert not any("joint" in text or "forces" in text for text in said.missing if "detected" not in text)


@pytest.mark.parametrize("oriented", [True, False])
def test_balls_roll_where_the_log_says_where_the_ground_is(tmp_path: Path, oriented: bool) -> None:
    """Without an orientation of the base, a fit refuses balls that roll, so that the file has none."""
    log = motion_of("hyq").log
    arrays = {name: getattr(log, name) for name in ("time", "joint_position", "joint_velocity", "joint_torque")}
    arrays |= {"imu_specific_force": np.tile([0.0, 0.0, 9.81], (len(log), 1)), "contact_active": log.contact_active}
    arrays |= {"imu_angular_velocity": np.zeros((len(log), 3))} | (
        {"base_quat_xyzw": log.base_quat_xyzw} if oriented else {}
    )
    names = {"joint_names": np.array(log.joint_names), "contact_names": np.array(log.contact_names)}
    np.savez(tmp_path / "log.npz", **arrays, **names)
    said = init(ROBOTS / MACHINES["hyq"][0], tmp_path / "log.npz", tmp_path / "new.yaml")
    setup = set_up(load_config(tmp_path / "new.yaml"))
    assert {bool(contact.radius) for contact in setup.contacts} == {oriented}
    assert ("radius 0, as no orientation" in str(said).replace("\n" + " " * 14, " ")) is not oriented
