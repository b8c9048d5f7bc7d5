"""Scalar sensors of contacts: logs with the force along the ground's normal, and what is identified with them.

Their rows are compared with Pinocchio's equations in `test_rows_against_oracle.py`.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from motions import value
from random_samples import random_samples
from raw_logs import log_refusal, write_arrays
from recordings import in_world
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import ANYMAL, TIAGO, Array, Oracle, load, make_log
from true_robots import true_parameters
from unknowns import fit

from torchid.errors import LogError, SensorError, UnknownNameError
from torchid.logs import Log, read_log, write_log
from torchid.logs.preprocess import preprocess
from torchid.problem import ExtraTerms, RowBuilder, bind_log, compress_parts
from torchid.sensing import Contact, SensorSet, chosen_sensors, named_sensors

ASKEW = (0.3, -0.2, 0.8)
NORMAL = np.array(ASKEW) / np.linalg.norm(ASKEW)
FEET = [Contact(f"{leg}_FOOT", "point", normal=ASKEW, along_normal=True) for leg in ("LF", "RF", "LH", "RH")]
NAMES = tuple(foot.frame for foot in FEET)
COUNT = 300


def a_log(**changes: Any) -> Log:
    """Unrelated motion and readings; the second foot stays in the air."""
    rng, robot = np.random.default_rng(0), load(ANYMAL)
    time = np.arange(COUNT) * 0.01
    active = np.sin(2.0 * time)[:, None] + [0.5, -9.0, 0.3, 0.9] > 0.0
    quat = np.array([0.0, 0.0, 0.0, 1.0]) + 0.01 * rng.normal(size=(COUNT, 4))
    return Log(
        "walk.npz",
        **{
            "time": time,
            "joint_names": robot.joint_names,
            "joint_position": rng.normal(size=(COUNT, 12)),
            "joint_torque": rng.normal(size=(COUNT, 12)),
            "base_quat_xyzw": quat / np.linalg.norm(quat, axis=1, keepdims=True),
            "base_position_world": rng.normal(size=(COUNT, 3)),
            "contact_names": NAMES[::-1],
            "contact_active": active,
            "contact_force_normal": np.where(active, 100.0 + rng.normal(size=(COUNT, 4)), 7.0),
            **changes,
        },
    )


def sensors_of(contacts: list[Contact], names: dict[str, list[str]]) -> SensorSet:
    joints = load(ANYMAL).joint_names
    return chosen_sensors(joints, contacts, joints, names)


EVERY_FOOT = {name: ["fn"] for name in NAMES}


# ----------------------------------------------------------------------------------------------------------- the field


@pytest.mark.parametrize("suffix", [".npz", ".h5", ".csv", ".parquet"])
def test_the_field_comes_back_from_every_format_and_in_the_order_of_the_contacts(tmp_path: Path, suffix: str) -> None:
    force = value(a_log().contact_force_normal).copy()
    force[5:9, 2] = np.nan
    log = a_log(contact_force_normal=force)
    write_log(log, tmp_path / f"log{suffix}")
    again = read_log(tmp_path / f"log{suffix}")
    np.testing.assert_array_equal(again.contact_force_normal, force)
    bound = value(bind_log(preprocess(again), load(ANYMAL), FEET).wrench).numpy()
    np.testing.assert_array_equal(bound[:, :, 2], force[2:-2, ::-1])
    assert np.isnan(bound[:, :, [0, 1, 3, 4, 5]]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"contact_force_normal": np.zeros((COUNT, 4, 1))}, "contact_force_normal: shape (300, 4, 1); accepted: shape"),
        ({"contact_force_normal": np.zeros((COUNT, 3))}, "contact_force_normal: shape (300, 3); accepted: shape"),
        ({"contact_force_normal": np.full((COUNT, 4), np.inf)}, "contact_force_normal: inf at sample 0, LF_FOOT"),
        ({"contact_active": None}, "contact_force_normal: given without contact_active"),
    ],
)  # fmt: skip
def test_a_field_that_is_none_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    names = ("time", "joint_position", "contact_active", "contact_force_normal")
    fields = {name: getattr(a_log(), name) for name in names} | {
        "joint_names": np.array(load(ANYMAL).joint_names),
        "contact_names": np.array(NAMES),
    }
    fields = {name: x for name, x in (fields | changes).items() if x is not None}
    assert message in log_refusal(write_arrays(tmp_path / "log.npz", fields))


# ------------------------------------------------------------------------------------------------------ what is refused


def test_fn_is_one_component_of_a_contact_and_alone() -> None:
    points = [replace(foot, along_normal=False) for foot in FEET]
    mixed = [FEET[0], *points[1:]]
    np.testing.assert_array_equal(
        np.argwhere(sensors_of(mixed, {"LF_FOOT": ["fn"], "RF_FOOT": ["fx"]}).wrench), [[0, 2], [1, 0]]
    )
    for contacts, names in ((mixed, ["fn", "fz"]), (mixed, ["fz"]), (points, ["fz", "fn"])):
        with pytest.raises(
            SensorError,
            match=r"sensors.contact_wrenches.LF_FOOT: 'fz', but this sensor measures only 'fn'; accepted: \[fn\], or",
        ):
            sensors_of(contacts, {"LF_FOOT": names})
    with pytest.raises(
        SensorError, match="'fn', but this contact has a wrench sensor; accepted: fx, fy, fz; .*along_norm"
    ):
        sensors_of(points, {"LF_FOOT": ["fn"]})
    with pytest.raises(UnknownNameError, match="sensors.contact_wrenches.LF_FOOT"):
        sensors_of(points, {"LF_FOOT": ["fm"]})


def test_what_is_missing_of_a_scalar_sensor_is_named() -> None:
    robot, sensors = load(ANYMAL), sensors_of(FEET, EVERY_FOOT)

    def message(log: Log, contacts: list[Contact] = FEET, required: SensorSet = sensors) -> str:
        return refused(lambda: bind_log(preprocess(log), robot, contacts, required), "walk.npz: contact_", LogError)

    force = value(a_log().contact_force_normal).copy()
    force[10, 3] = np.nan
    found = message(a_log(contact_force_normal=force))
    assert "contact_force_normal 'LF_FOOT': not a finite number at sample 8, during contact" in found
    force[:] = np.where(value(a_log().contact_active), 1.0, np.nan)  # in the air nothing needs to have been read
    bind_log(preprocess(a_log(contact_force_normal=force)), robot, FEET, sensors)
    wrench = np.zeros((COUNT, 4, 6))
    assert "contact_force_normal 'LF_FOOT': missing; accepted: the field, or sensors without fn" in message(
        a_log(contact_force_normal=None, contact_wrench_local=wrench)
    )
    full = named_sensors("full", robot.n, 4)
    assert "contact_force_normal 'LF_FOOT': fx is not measured, only the force along the ground's normal" in message(
        a_log(), FEET, full
    )
    points = [replace(foot, along_normal=False) for foot in FEET]
    hint = "accepted: contact_wrench_local or contact_wrench_world, or sensors.contact_wrenches: {FRAME: [fn]} to use"
    assert hint in message(a_log(), points, full)
    assert hint[:65] not in message(a_log(contact_force_normal=None), points, full).replace(hint[:64], "", 1)


# --------------------------------------------------------------------------------------------------- what is identified


@cache
def walked(seed: int) -> tuple[Log, Array]:
    """A log of feet on slanted ground with the forces along its normal, from Pinocchio, and the true parameters."""
    robot = load(ANYMAL)
    oracle = Oracle.of(robot)
    oracle.perturb(np.random.default_rng(5), 0.2)
    states = [[True] * 4, [True, False, True, True], [False, True, True, False], [False] * 4]
    log = make_log(oracle, [(name, 3) for name in NAMES], states, 400, np.random.default_rng(seed), f"{seed}.npz")
    force = value(in_world(oracle, log).contact_wrench_world)[..., :3] @ NORMAL
    return replace(log, contact_force_normal=force), true_parameters(oracle, robot).ravel()


def read_by(fn: Collection[str], wrench: Collection[str]) -> tuple[list[Contact], SensorSet]:
    """Feet with a scalar sensor, and with one of the force; torques of the left legs too."""
    contacts = [replace(foot, along_normal=foot.frame in fn) for foot in FEET]
    chosen = {name: ["fn"] for name in fn} | {name: ["fx", "fy", "fz"] for name in wrench}
    joints = load(ANYMAL).joint_names
    return contacts, chosen_sensors(joints, contacts, joints[:6], chosen)


@pytest.mark.parametrize("world", [False, True])
def test_offsets_and_scales_of_scalar_sensors_are_recovered_with_the_parameters(world: bool) -> None:
    robot, (log, phi), (held_out, _) = load(ANYMAL), walked(1), walked(2)
    contacts, sensors = read_by(("LF_FOOT", "LH_FOOT", "RF_FOOT"), ("RH_FOOT",))
    offset, scale = np.array([12.0, -7.0, 30.0, 0.0]), np.array([1.1, 0.8, 1.3, 1.0])
    force = value(log.contact_force_normal)
    read = replace(log, contact_force_normal=np.where(value(log.contact_active), (force + offset) / scale, np.nan))
    if world:
        oracle = Oracle.of(robot)
        read, held_out = in_world(oracle, read), in_world(oracle, held_out)
    terms = ExtraTerms(offsets={"contact_force": "all"}, scales={"contact_force": "all"})
    done = fit(robot, contacts, sensors, terms, [bind_log(read, robot, contacts, sensors)])
    values = {name.removeprefix("offset of "): x for (_, name), x in done.values.items() if name.startswith("off")}
    scales = {name.removeprefix("scale of "): x for (_, name), x in done.values.items() if name.startswith("scale")}
    for index, name in enumerate(NAMES[:3]):
        assert values[f"{name} fn"] == pytest.approx(offset[index], abs=1e-7)
        assert scales[f"{name} fn"] == pytest.approx(scale[index] - 1.0, abs=1e-9)
    others = [x for name, x in values.items() if name.startswith("RH_FOOT")]
    np.testing.assert_allclose(others, 0.0, atol=1e-6)
    assert len(values) == len(scales) == 6
    builder = RowBuilder(robot, contacts, sensors)
    for part in compress_parts([bind_log(held_out, robot, contacts, sensors)], builder, threads=1):
        R = part.factor.triangle().numpy()
        for parameters in (phi, done.estimate.phi):
            misfit = R[:, :-1] @ builder.to_columns(parameters[None])[0].numpy() - R[:, -1]
            assert np.abs(misfit).max() < 1e-9 * np.abs(R[:, -1]).max()


def test_cells_in_a_level_sole_leave_what_is_not_in_its_plane() -> None:
    """Forces in the plane of three cells, and the moment about its normal, are all that is not measured."""
    frames = ("base_link", "base_imu_link", "caster_front_left_1_link")
    robot, rng = load(TIAGO), np.random.default_rng(0)
    cells = [Contact(frame, "point", along_normal=True) for frame in frames]
    wrench = np.zeros((3, 6), dtype=bool)
    wrench[:, 2] = True
    builder = RowBuilder(robot, cells, SensorSet(np.zeros(robot.n_dofs, dtype=bool), wrench))
    samples, (q, _, _) = random_samples(robot, cells, 10, 0)
    first, second, third = (robot.link(frame)[1][:3, 3] for frame in frames)
    across = np.cross(second - first, third - first)
    across /= np.linalg.norm(across)
    for tilted, rank in ((False, 3), (True, 1)):
        normal = Rotation.from_quat(q[:, 3:7]).apply(across) + 0.2 * tilted * rng.normal(size=(10, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        level = replace(samples, contact_normal=torch.from_numpy(normal)[:, None].expand(-1, 3, -1))
        _, W = builder.rows_by_sample(level, (True,) * 3)
        np.testing.assert_array_equal(W.numpy().any(axis=1).sum(axis=1), rank)
