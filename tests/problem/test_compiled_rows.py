"""Rows by compiled kernels are those of torch's operators, whatever the robot, its sensors and its contacts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from random_samples import NOISE, random_samples, sensor_set
from synthetic import PANDA, TALOS, TALOS_FULL, load

import torchid
from torchid.problem import RowBuilder, Samples, chunks, compress
from torchid.problem.chunk_dynamics import Workspace
from torchid.problem.chunks import choose_kernels, chunks_by_state
from torchid.problem.extras import ExtraTerms

pytest.importorskip("numba", reason="compiled kernels need Numba, of the extra [fast]")

QUADRUPED = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
POINTS = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
SOLES = [torchid.Contact(f"{side}_sole_link", "flat") for side in ("left", "right")]
ENOUGH = 10**9  # samples of a pass for which kernels are used


def builders(
    robot: torchid.Robot, contacts: list[torchid.Contact], sensors: torchid.SensorSet, terms: ExtraTerms | None = None
) -> list[RowBuilder]:
    """With torch's operators, and with kernels."""
    plain, fast = (RowBuilder(robot, contacts, sensors, terms) for _ in range(2))
    choose_kernels(fast, ENOUGH)
    assert fast.compiled is not None
    return [plain, fast]


def by_axis(sensors: torchid.SensorSet) -> torchid.SensorSet:
    """With noise of the base that differs from axis to axis of the levelled base."""
    noise = replace(sensors.noise, base_force=(0.3, 2.0, 0.9), base_moment=(0.2, 0.03, 0.08))
    return replace(sensors, noise=noise)


def assert_same_rows(plain: RowBuilder, fast: RowBuilder, samples: Samples) -> int:
    """Block by block, entry by entry; returns in how many chunks kernels made them."""
    workspace, made = Workspace(), 0
    for state, index in chunks_by_state(samples):
        part = samples[index]
        expected = [(columns, rows.clone()) for columns, rows in plain.rows(part, state)]
        found = [(columns, rows.clone()) for columns, rows in fast.rows(part, state, workspace)]
        assert [columns for columns, _ in found] == [columns for columns, _ in expected]
        for (_, rows), (_, reference) in zip(found, expected, strict=True):
            size = reference.abs().amax(0) + 1e-3 * reference.abs().max()
            # a limb of condition 1e4, the worst that neither takes the general way with, leaves 12 digits
            np.testing.assert_allclose(rows / size, reference / size, rtol=0.0, atol=1e-10)
        layout = fast.layout(state, part.contact_normal is not None)
        made += fast.compiled is not None and fast.compiled.blocks(part, layout, workspace) is not None
    return made


@pytest.mark.parametrize("sensors", ["joints", "mixed", "contacts", "full"])
@pytest.mark.parametrize(
    ("robot", "contacts"),
    [
        (QUADRUPED, POINTS),
        (load(TALOS), SOLES),
        (load(TALOS_FULL), SOLES),
        (load(PANDA, fixed_base=True), []),
    ],
    ids=["quadruped", "biped", "mimic joints", "arm with a prismatic gripper"],
)
def test_rows_are_those_of_torch(robot: torchid.Robot, contacts: list[torchid.Contact], sensors: str) -> None:
    samples = random_samples(robot, contacts, 300, 3, states=3)[0]
    alike = sensor_set(sensors, robot, contacts)
    for own in (alike,) if robot.fixed_base else (alike, by_axis(alike)):
        plain, fast = builders(robot, contacts, own)
        assert assert_same_rows(plain, fast, samples) == len(list(chunks_by_state(samples)))


def test_a_sensor_in_a_limb_has_rows_of_all_six_components() -> None:
    robot = load(TALOS_FULL, ft_joints=("wrist_left_ft_joint",))
    sensors = torchid.named_sensors("full", robot.n, 0, NOISE, len(robot.ft_names))
    samples = random_samples(robot, [], 70, 1)[0]
    samples = replace(samples, torque=torch.cat([samples.torque, samples.torque[:, :6]], dim=1))
    assert assert_same_rows(*builders(robot, [], sensors), samples) == 1


def test_a_known_payload_and_smooth_friction_are_in_the_rows() -> None:
    sensors = sensor_set("joints", QUADRUPED, POINTS)
    plain, fast = builders(QUADRUPED, POINTS, sensors)
    samples = random_samples(QUADRUPED, POINTS, 200, 5, states=1)[0]
    payload = np.random.default_rng(0).normal(size=QUADRUPED.nominal.size)
    assert assert_same_rows(plain, fast, replace(samples, payload=payload)) == 1
    assert assert_same_rows(plain, fast, replace(samples, resting=samples.joint_position > 0.0)) == 0, "torch's"


@pytest.mark.parametrize("sensors", ["joints", "mixed"])
def test_extra_parameters_of_joints_are_in_the_rows(sensors: str) -> None:
    actuators = dict.fromkeys(("armature", "stiffness", "asymmetric_coulomb", "torque_offset"), True)
    terms = ExtraTerms(**actuators, scales={"joint_torque": (("front_*",), ("rear_*",))}, stribeck=0.1, delay=True)
    plain, fast = builders(QUADRUPED, POINTS, sensor_set(sensors, QUADRUPED, POINTS), terms)
    samples = random_samples(QUADRUPED, POINTS, 300, 8, states=3)[0]
    assert assert_same_rows(plain, fast, samples) == len(list(chunks_by_state(samples)))
    of_contacts = ExtraTerms(offsets={"contact_force": "all"})
    other = RowBuilder(QUADRUPED, POINTS, sensor_set(sensors, QUADRUPED, POINTS), of_contacts)
    choose_kernels(other, ENOUGH)
    assert (other.compiled is None) == bool(other.extras), "torch's"


@pytest.mark.parametrize("of_base", [lambda x: x, by_axis], ids=["alike", "by axis"])
def test_straight_knees_are_no_exception(
    of_base: Callable[[torchid.SensorSet], torchid.SensorSet], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("torchid.problem.compiled_rows.CompiledRows._bases")  # which takes W from torch
    plain, fast = builders(QUADRUPED, POINTS, of_base(sensor_set("joints", QUADRUPED, POINTS)))
    samples = random_samples(QUADRUPED, POINTS, 100, 6, states=1)[0]
    position = samples.joint_position.clone()
    position[7], position[70, :3] = 0.0, 0.0
    samples = replace(samples, active=torch.ones_like(samples.active), joint_position=position)
    assert assert_same_rows(plain, fast, samples) == 1


def test_a_numba_that_does_not_work_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    builder = RowBuilder(QUADRUPED, POINTS, sensor_set("joints", QUADRUPED, POINTS))
    monkeypatch.setitem(sys.modules, "torchid.problem.compiled_rows", None)  # importing it then fails
    with pytest.warns(torchid.errors.TorchidWarning, match="Numba: .*without it"):
        choose_kernels(builder, ENOUGH)
    assert builder.compiled is None


def test_long_passes_use_kernels_and_give_the_same_factor(monkeypatch: pytest.MonkeyPatch) -> None:
    sensors = sensor_set("joints", QUADRUPED, POINTS)
    builder = RowBuilder(QUADRUPED, POINTS, sensors)
    samples = random_samples(QUADRUPED, POINTS, 5000, 7, states=2)[0]
    expected = compress([samples], builder).triangle()
    assert builder.compiled is None, "too few samples"
    monkeypatch.setattr(chunks, "_WORTH_LOADING", len(samples))
    found = compress([samples], builder).triangle()
    assert builder.compiled is not None
    gram = expected.T @ expected
    size = gram.diagonal().clamp(min=1e-12).sqrt()
    np.testing.assert_allclose(
        found.T @ found / size / size[:, None], gram / size / size[:, None], rtol=0.0, atol=1e-12
    )
