"""Normals of the ground that logs record, what needs an orientation, and the public Jacobian of what rolls."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lxml import etree
from random_samples import random_samples, sensor_set
from raw_logs import log_refusal, write_arrays
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import ANYMAL, PANDA, SOLO12, Array, load

import torchid
from torchid.errors import LogError, SensorError
from torchid.identifiability.base_parameters import standing_states
from torchid.logs import Log, read_log, write_log
from torchid.logs.preprocess import preprocess
from torchid.problem import RowBuilder, bind_log, compress
from torchid.problem.base_pose import feet_poses
from torchid.sensing import Contact

ASKEW = (0.3, -0.2, 0.8)
BALLS = [Contact(f"{leg}_FOOT", "point", radius=0.04, normal=ASKEW) for leg in ("LF", "RF", "LH", "RH")]


def unit(x: Array) -> Array:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


# ---------------------------------------------------------------------------------------------------------- Jacobians


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize(
    ("urdf", "fixed_base", "contacts"),
    [
        (ANYMAL, False, [*BALLS[:2], Contact("LH_FOOT", "line", "x", 0.1, ASKEW), Contact("RH_FOOT", "point")]),
        (PANDA, True, [Contact("panda_hand", "line", "z", 0.1, ASKEW), Contact("panda_rightfinger", "point", "x", 1)]),
    ],
)  # fmt: skip
def test_the_public_jacobian_is_that_of_the_rows(
    urdf: Path, fixed_base: bool, contacts: list[Contact], recorded: bool
) -> None:
    robot = load(urdf, fixed_base=fixed_base)
    samples, (q, _, _) = random_samples(robot, contacts, 20, 0)
    normals = torch.tensor([contact.normal for contact in contacts], dtype=torch.float64).expand(20, -1, 3)
    if recorded:
        normals = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(20, len(contacts), 3))))
        samples = replace(samples, contact_normal=normals)
    J = RowBuilder(robot, contacts, sensor_set("full", robot, contacts)).contact_jacobian(samples)
    for index, contact in enumerate(contacts):
        frame = torchid.FrameJacobian(robot, contact.frame, contact.radius, contact.rolling_axis)
        torch.testing.assert_close(frame(torch.from_numpy(q), normals[:, index]), J[:, index], rtol=0.0, atol=1e-14)


def test_the_jacobian_of_a_ball_gives_the_velocity_of_the_material_point() -> None:
    """Twist of the centre, and the arm to the ground in the frame's axes, from poses."""
    robot, rng = load(SOLO12), np.random.default_rng(0)
    _, (q, v, _) = random_samples(robot, [], 5, 0)
    normal, radius = unit(rng.normal(size=(5, 3))), 0.07
    J = torchid.FrameJacobian(robot, "FL_FOOT", radius)(torch.from_numpy(q), torch.from_numpy(normal))
    plain = torchid.FrameJacobian(robot, "FL_FOOT")(torch.from_numpy(q))
    speed, twist = ((x @ torch.from_numpy(v)[..., None])[..., 0].numpy() for x in (J, plain))
    poses = robot.link_poses(torch.from_numpy(q[:, 7:]))["FL_FOOT"][:, :3, :3].numpy()
    bases = Rotation.from_quat(q[:, 3:7]).as_matrix()
    for i in range(5):
        arm = -radius * (bases[i] @ poses[i]).T @ normal[i]
        np.testing.assert_allclose(speed[i, :3], twist[i, :3] + np.cross(twist[i, 3:], arm), atol=1e-12)
        np.testing.assert_allclose(speed[i, 3:], twist[i, 3:], atol=1e-13)


# --------------------------------------------------------------------------------------------------- logs with normals


def a_log(**changes: Any) -> Log:
    rng, robot = np.random.default_rng(0), load(ANYMAL)
    count = 60
    active = rng.random((count, 4)) < 0.7
    return Log(
        "walk.npz",
        **{
            "time": np.arange(count) * 0.01,
            "joint_names": robot.joint_names,
            "joint_position": rng.normal(size=(count, 12)),
            "base_quat_xyzw": unit(np.array([0.0, 0.0, 0.0, 1.0]) + 0.01 * rng.normal(size=(count, 4))),
            "base_position_world": rng.normal(size=(count, 3)),
            "contact_names": tuple(contact.frame for contact in BALLS[::-1]),
            "contact_active": active,
            "contact_wrench_local": rng.normal(size=(count, 4, 6)),
            "contact_normal_world": np.where(active[..., None], unit(rng.normal(size=(count, 4, 3))), np.nan),
            **changes,
        },
    )


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".csv", ".parquet"])
def test_normals_come_back_from_every_format_and_in_the_order_of_the_contacts(tmp_path: Path, suffix: str) -> None:
    log = a_log()
    write_log(log, tmp_path / f"log{suffix}")
    again = read_log(tmp_path / f"log{suffix}")
    np.testing.assert_array_equal(again.contact_normal_world, log.contact_normal_world)
    bound = bind_log(preprocess(again), load(ANYMAL), BALLS).contact_normal
    assert bound is not None
    assert log.contact_normal_world is not None
    np.testing.assert_array_equal(bound.numpy(), log.contact_normal_world[2:-2, ::-1])


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda n: n * 1.01, "norm 1.01 at sample 3, LH_FOOT, while in contact; accepted: unit vectors, within 0.001"),
        (lambda n: n * np.nan, "norm nan at sample 3, LH_FOOT, while in contact; accepted: unit vectors, within 0.001"),
        (lambda n: n * 0.0, "norm 0 at sample 3, LH_FOOT, while in contact; accepted: unit vectors, within 0.001"),
        (lambda n: n * np.inf, "at sample 3, LH_FOOT x; accepted: finite numbers, or NaN"),
    ],
)
def test_a_normal_that_is_none_is_refused_by_name(tmp_path: Path, change: Any, found: str) -> None:
    log = a_log()
    normals, active = log.contact_normal_world, log.contact_active
    assert normals is not None
    assert active is not None
    normals, active = normals.copy(), active.copy()
    active[3, 1], normals[3, 1] = True, [1.0, 0.0, 0.0]
    with np.errstate(invalid="ignore"):
        normals[3, 1] = change(np.array([0.6, 0.0, 0.8]))
    fields = {
        "time": log.time,
        "joint_names": np.array(log.joint_names),
        "joint_position": log.joint_position,
        "contact_names": np.array(log.contact_names),
        "contact_active": active,
        "contact_normal_world": normals,
    }
    message = log_refusal(write_arrays(tmp_path / "log.npz", fields))
    assert "contact_normal_world: " in message
    assert found in message
    if "finite" not in found:
        changed = replace(preprocess(log), contact_normal_world=normals[2:-2], contact_active=active[2:-2])
        message = refused(lambda: bind_log(changed, load(ANYMAL), BALLS), "walk.npz: contact_normal_world", LogError)
        assert found.replace("sample 3", "sample 1") in message


def test_normals_need_flags_of_contacts(tmp_path: Path) -> None:
    fields = {"time": [0.0, 1.0], "joint_names": ["a"], "joint_position": [[0.0], [0.0]]}
    normals = np.zeros((2, 1, 3))
    path = write_arrays(tmp_path / "log.npz", fields | {"contact_normal_world": normals})
    assert "contact_normal_world: given without contact_names" in log_refusal(path)


# --------------------------------------------------------------------------------------------------------- refusals


def test_what_rolls_needs_the_orientation_of_the_base() -> None:
    imu = {name: np.zeros((60, 3)) for name in ("imu_specific_force", "imu_angular_velocity")}
    log = preprocess(
        a_log(base_quat_xyzw=None, base_position_world=None, contact_normal_world=None, imu_frame="base", **imu)
    )
    message = refused(lambda: bind_log(log, load(ANYMAL), BALLS), "walk.npz: base_quat_xyzw: ", LogError)
    assert "missing, but LF_FOOT (radius 0.04 m) needs the ground's normal in the base frame" in message
    assert "base_quat_wxyz or base_quat_xyzw beside the IMU, or radius: 0 for this contact" in message
    assert bind_log(log, load(ANYMAL), [replace(contact, radius=0.0) for contact in BALLS]).base.quat_xyzw is None


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"radius": -0.1}, "contact 'a': radius: -0.1; accepted: a number of at least 0"),
        ({"radius": float("nan")}, "contact 'a': radius: nan; accepted: a number of at least 0"),
        ({"radius": 0.1, "kind": "flat"}, "contact 'a': radius: 0.1 for a flat contact; accepted: type point"),
        (
            {"normal": (0.0, 0.0, 0.0)},
            r"contact 'a': normal: \[0, 0, 0\]; accepted: three numbers in the world, not all 0",
        ),
        (
            {"normal": (0.0, float("nan"), 0.0)},
            r"contact 'a': normal: \[0, nan, 0\]; accepted: three numbers in the world",
        ),
    ],
)
def test_a_contact_that_cannot_be_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(SensorError, match=message):
        Contact(**{"frame": "a", "kind": "point"} | wrong)


# ------------------------------------------------------------------------------------------- centres beside the frame


def test_a_ball_beside_a_frame_is_one_about_a_link_welded_at_its_centre(tmp_path: Path) -> None:
    root = etree.parse(str(ANYMAL)).getroot()
    for contact in BALLS:
        etree.SubElement(root, "link", name=f"{contact.frame}_ball")
        weld = etree.SubElement(root, "joint", name=f"{contact.frame}_weld", type="fixed")
        etree.SubElement(weld, "parent", link=contact.frame)
        etree.SubElement(weld, "child", link=f"{contact.frame}_ball")
        etree.SubElement(weld, "origin", xyz="0.01 -0.005 0.023")
    (tmp_path / "balls.urdf").write_bytes(etree.tostring(root))
    robot = load(tmp_path / "balls.urdf")
    beside = [replace(contact, centre=(0.01, -0.005, 0.023)) for contact in BALLS]
    welded = [replace(contact, frame=f"{contact.frame}_ball") for contact in BALLS]
    grams, jacobians, states = [], [], []
    for contacts in (beside, welded, BALLS):
        samples, (q, _, _) = random_samples(robot, contacts, 40, 0, states=4)
        factor = compress([samples], RowBuilder(robot, contacts, sensor_set("joints", robot, contacts))).triangle()
        grams.append(factor.T @ factor)
        frame = contacts[0].frame, 0.04, None, contacts[0].centre
        jacobians.append(torchid.FrameJacobian(robot, *frame)(torch.from_numpy(q)))
        states.append(standing_states(robot, contacts, (True,) * 4, 5, np.random.default_rng(0))[2])
    for found in (grams, jacobians, states):
        torch.testing.assert_close(found[0], found[1], rtol=1e-9, atol=1e-9)
        assert not torch.allclose(found[0], found[2])
    log = a_log()
    log = replace(log, joint_names=robot.joint_names, contact_names=tuple(contact.frame for contact in BALLS))
    poses = [list(feet_poses(log, robot, contacts).values()) for contacts in (beside, welded)]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-12)
