"""Force/torque sensors in limbs are judged by what hangs on them while nothing beyond them touches."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import found, only
from scipy.spatial.transform import Rotation
from synthetic import Array
from welded import machine

from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Checked
from torchid.log_checks.check import check
from torchid.log_checks.contacts import _limb_sensor_findings
from torchid.logs import Log
from torchid.regressor import Regressor
from torchid.robot import load_robot
from torchid.sensing import Contact

NAMES = ("thigh_ft", "ankle_ft")
STANDS = slice(500, 700)
Seen = Callable[[Callable[[Array], Array]], Checked]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """What is said of a machine that swings for 8 s and stands on its sole for one, its ankle's readings changed."""
    robot = load_robot(machine(tmp_path_factory.mktemp("swung")), fixed_base=True, ft_joints=NAMES)
    time, rng = np.arange(1600) / 200.0, np.random.default_rng(0)
    w, amplitude = 2.0 * np.pi * np.array([0.31, 0.23, 0.4]), np.array([0.9, 0.1, 0.7])
    angle = w * time[:, None] + [0.0, 1.0, 2.0]
    q, v, a = (amplitude * w**order * np.sin(angle + order * np.pi / 2.0) for order in range(3))
    forces = Regressor(robot)(*map(torch.from_numpy, (q, v, a))) @ torch.from_numpy(robot.nominal.flatten())
    wrench = forces[:, robot.n :].numpy().reshape(-1, 2, 6)[:, [robot.ft_names.index(name) for name in NAMES]]
    wrench = wrench + 0.05 * rng.normal(size=wrench.shape)
    wrench[STANDS] += 40.0
    active = np.zeros((len(time), 1), bool)
    active[STANDS] = True
    log = Log("swung.npz", time, robot.joint_names, q, contact_names=("sole",), contact_active=active)

    def check_with(change: Callable[[Array], Array]) -> Checked:
        changed = wrench.copy()
        changed[:, 1] = change(wrench[:, 1])
        return check(replace(log, ft_names=NAMES, ft_wrench=changed), robot, (Contact("sole", "flat"),))

    return check_with


def test_what_hangs_on_a_sensor_is_no_finding(seen: Seen) -> None:
    checked = seen(lambda wrench: wrench)
    assert [one.name for one in checked.findings] == []
    assert [one.name for one in checked.skipped if one.name == "limb sensors in the air"] == []


def test_an_offset_is_named_with_its_size(seen: Seen) -> None:
    offset = only(seen(lambda wrench: wrench + [3.0, 0.0, 4.0, 0.0, 0.0, 0.0]), "offset")
    assert (offset.severity, offset.field, offset.channels) == (NOTE, "ft_wrench", ("ankle_ft",))
    assert "a constant 5 N" in offset.found.replace("4.99", "5").replace("5.01", "5")
    assert "ft_force: log" in offset.advice


def test_a_mass_beside_noise_of_accelerations_is_no_offset(tmp_path: Path) -> None:
    robot, rng = load_robot(machine(tmp_path), fixed_base=True, ft_joints=NAMES), np.random.default_rng(1)
    angle = 0.15 * np.sin(np.linspace(0.0, 9.0, 100))
    hangs = 45.0 * np.stack([np.sin(angle), 0.0 * angle, -np.cos(angle)], axis=1)
    model, measured = hangs + 1.2 * rng.normal(size=hangs.shape), 1.1 * hangs
    assert not list(_limb_sensor_findings("thigh_ft", measured, model, robot))
    shifted = list(_limb_sensor_findings("thigh_ft", measured + [5.0, 0.0, 5.0], hangs, robot))
    assert [one.name for one in shifted] == ["offset"]


def test_a_reversed_sensor_and_one_of_another_gain_are_named_whatever_their_offset(seen: Seen) -> None:
    for offset in (0.0, 20.0):
        turned = only(seen(lambda wrench, offset=offset: offset - wrench), "sign", "ft_wrench")  # type: ignore[misc]
        assert (turned.severity, turned.channels) == (REJECTED, ("ankle_ft",))
        heavy = only(seen(lambda wrench, offset=offset: offset + 1.5 * wrench), "weight")  # type: ignore[misc]
        assert (heavy.severity, heavy.channels) == (SUSPICIOUS, ("ankle_ft",))
        assert "reads 1.5 times" in heavy.found


@pytest.mark.parametrize("rpy", [(0, 0, 90), (90, 0, 0), (0, -90, 180)])
def test_a_sensor_mounted_in_another_right_angle_is_named_with_the_axes(seen: Seen, rpy: tuple[int, ...]) -> None:
    to_sensor = Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    turned = only(seen(lambda wrench: wrench @ np.kron(np.eye(2), to_sensor.T)), "frame", "ft_wrench")
    assert (turned.severity, turned.channels) == (SUSPICIOUS, ("ankle_ft",))
    words = re.search(r"x, y, z are (-?[xyz]), (-?[xyz]), (-?[xyz]) of the readings", turned.advice)
    assert words is not None
    back = [np.eye(3)["xyz".index(word[-1])] * (-1.0 if word[0] == "-" else 1.0) for word in words.groups()]
    np.testing.assert_allclose(np.array(back) @ to_sensor, np.eye(3), atol=1e-12)


def test_a_sensor_with_gaps_is_not_judged_and_said_so(seen: Seen) -> None:
    gaps = seen(lambda wrench: np.where(np.arange(len(wrench))[:, None] // 50 % 2 == 0, wrench, np.nan))
    assert not found(gaps, "offset", "ft_wrench")
    assert [one.reason for one in gaps.skipped if one.name == "limb sensors in the air"] == [
        "ankle_ft: too few readings while nothing beyond it touches"
    ]
