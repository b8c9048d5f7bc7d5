"""`torchid init` of arrays without names, whose joints and feet are in the order of another program."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from dialects import save_csv
from initiated import URDF, recorded
from motions import value

from torchid.commands.init import init
from torchid.config import load_config
from torchid.log_checks.mistakes import joint_orders
from torchid.logs import Log, read_log
from torchid.robot import load_robot

ORDERS = joint_orders(load_robot(URDF))


def saved(
    path: Path, joints: tuple[str, ...], feet: list[str], fields: tuple[str, ...], urdf: Path = URDF
) -> tuple[Log, Log, str]:
    """What was recorded, what is read of arrays in an order through init's map, and what init says."""
    log = recorded()
    at, of_feet = (
        [known.index(name) for name in names] for known, names in ((log.joint_names, joints), (log.contact_names, feet))
    )
    arrays = {"dof_pos": value(log.joint_position), "dof_torque": value(log.joint_torque)}
    arrays = {name: x[:, at] for name, x in arrays.items() if name in fields}
    arrays |= {"foot_contacts": value(log.contact_active)[:, of_feet]}
    np.savez(path / "x.npz", t=log.time, root_pos=log.base_position_world, root_quat_xyzw=log.base_quat_xyzw, **arrays)
    said = init(urdf, path / "x.npz", path / "x.yaml")
    files = load_config(path / "x.yaml").logs
    assert files is not None
    return log, read_log(path / "x.npz", columns=files.columns), " ".join(said.guessed)


def assert_alike(log: Log, read: Log) -> None:
    at = [read.joint_names.index(name) for name in log.joint_names]
    np.testing.assert_array_equal(read.joint_position[:, at], log.joint_position)
    feet = [read.contact_names.index(name) for name in log.contact_names]
    np.testing.assert_array_equal(value(read.contact_active)[:, feet], log.contact_active)


@pytest.mark.parametrize("how", sorted(ORDERS))
def test_forces_tell_the_order_of_joints_and_of_feet(tmp_path: Path, how: str) -> None:
    legs = list(dict.fromkeys(name.rpartition("_")[0] for name in ORDERS[how]))
    log, read, said = saved(tmp_path, ORDERS[how], [f"{leg}_foot" for leg in legs], ("dof_pos", "dof_torque"))
    assert_alike(log, read)
    assert "forces differ from the robot's file by" in said


def test_limits_tell_an_order_where_no_force_was_recorded(tmp_path: Path) -> None:
    """Knees are bent further than hips go."""
    how, urdf = "breadth-first order", tmp_path / "narrow.urdf"
    urdf.write_text(URDF.read_text().replace('lower="-3" upper="3"', 'lower="-1.5" upper="1.5"'))
    urdf.write_text(re.sub(r'(_knee"(?:(?!</joint>)[\s\S])*?)lower="-1.5"', r'\1lower="-3"', urdf.read_text()))
    log, read, said = saved(tmp_path, ORDERS[how], list(recorded().contact_names), ("dof_pos",), urdf)
    assert_alike(log, read)
    assert "beyond their limits" in said
    assert how in said


def test_numbered_columns_with_the_base_in_front_are_no_motors(tmp_path: Path) -> None:
    """A position and a quaternion before twelve joints, as simulators write them, are no motors 0 to 6."""
    log = recorded()
    states = np.hstack([value(log.base_position_world), value(log.base_quat_xyzw), value(log.joint_position)])
    rates = np.hstack([np.zeros((len(log), 6)), value(log.joint_velocity)])
    columns = {f"{name}[{k}]": x for name, of in (("gc", states), ("gv", rates)) for k, x in enumerate(of.T)}
    said = init(URDF, save_csv(tmp_path / "x.csv", {"t": log.time, **columns}), tmp_path / "x.yaml")
    assert any("19 columns like 'gc[0]'" in text for text in said.missing)
    assert "joint_" not in (tmp_path / "x.yaml").read_text()
