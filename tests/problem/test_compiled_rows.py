"""Rows by compiled kernels are those of torch's operators, whatever the robot, its sensors and its contacts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from random_samples import NOISE, random_samples, sensor_set
from synthetic import PANDA, TALOS, TALOS_FULL, load

import torchid
from torchid import kernels
from torchid.problem import RowBuilder, Samples, TriangularFactor, compress, compress_parts, row_compressor
from torchid.problem.chunks import choose_kernels, chunks_by_state
from torchid.problem.compiled_rows import CompiledChunk
from torchid.problem.extras import ExtraTerms
from torchid.problem.rows import Workspace

QUADRUPED = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
POINTS = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
SOLES = [torchid.Contact(f"{side}_sole_link", "flat") for side in ("left", "right")]
MANY = 10**9  # samples
pytestmark = pytest.mark.skipif(kernels.compiled() is None, reason=kernels.why_not_compiled())


def builders(
    robot: torchid.Robot, contacts: list[torchid.Contact], sensors: torchid.SensorSet, terms: ExtraTerms | None = None
) -> list[RowBuilder]:
    """With torch's operators, and with kernels."""
    plain, fast = (RowBuilder(robot, contacts, sensors, terms) for _ in range(2))
    choose_kernels(fast, MANY)
    assert fast.compiled is not None
    return [plain, fast]


def by_axis(sensors: torchid.SensorSet) -> torchid.SensorSet:
    """With noise of the base that differs from axis to axis of the levelled base."""
    noise = replace(sensors.noise, base_force=(0.3, 2.0, 0.9), base_moment=(0.2, 0.03, 0.08))
    return replace(sensors, noise=noise)


@contextmanager
def without_kernels() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "compiled", lambda: None)
        yield


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
        made += fast.compiled is not None and fast.compiled.chunk(part, layout, workspace) is not None
    return made


def assert_same_factors(found: TriangularFactor, expected: TriangularFactor) -> None:
    assert (found.rows, found.independent_rows) == (expected.rows, expected.independent_rows)
    assert_same_grams(found.triangle(), expected.triangle())


def assert_same_grams(found: torch.Tensor, expected: torch.Tensor) -> None:
    gram = expected.T @ expected
    size = gram.diagonal().sqrt()
    size = size.clamp(min=1e-3 * size.max())  # of a column that is zero rounding is left
    np.testing.assert_allclose(
        found.T @ found / size / size[:, None], gram / size / size[:, None], rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize("sensors", ["joints", "mixed", "contacts", "full", "nothing"])
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


@pytest.mark.parametrize(
    ("columns", "rows", "lower"), [(1, 1, 0), (2, 385, 1), (7, 400, 3), (13, 1000, 0), (24, 30, 5)]
)
def test_gram_matrices_are_those_of_numpy(columns: int, rows: int, lower: int) -> None:
    rng = np.random.default_rng(columns)
    X, combination = rng.normal(size=(columns, columns + rows)), rng.normal(size=(lower, columns))
    chosen = np.sort(rng.permutation(columns)[:lower])
    changed, expected = X.copy(), X.copy()
    (gram, squares), (reference, before) = ((np.full((columns, columns), np.nan), np.full(lower, np.nan)) for _ in "ab")
    row_compressor.write_gram(changed, columns, chosen, combination, squares, gram)
    with without_kernels():
        row_compressor.write_gram(expected, columns, chosen, combination, before, reference)
    np.testing.assert_array_equal(changed[:, :columns], X[:, :columns])
    np.testing.assert_allclose(changed, expected, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(squares, before, rtol=1e-13)
    np.testing.assert_allclose(gram, reference, rtol=0.0, atol=1e-13 * reference.max())
    np.testing.assert_array_equal(gram, gram.T)


@pytest.mark.parametrize("sensors", ["joints", "full"])
@pytest.mark.parametrize(
    ("robot", "contacts"),
    [(QUADRUPED, POINTS), (load(TALOS_FULL), SOLES), (load(PANDA, fixed_base=True), [])],
    ids=["quadruped", "biped with mimic joints", "arm"],
)
def test_rows_that_are_multiplied_at_once_give_the_same_factor(
    robot: torchid.Robot, contacts: list[torchid.Contact], sensors: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_compressor, "_LEAST_ROWS", 0)
    monkeypatch.setattr(row_compressor, "_ROWS_PER_COLUMN", 1)
    monkeypatch.setattr(row_compressor, "_MOST_COMBINED", 1.0)
    plain, fast = builders(robot, contacts, sensor_set(sensors, robot, contacts))
    samples = random_samples(robot, contacts, 2500, 4, states=1)[0]
    with without_kernels():
        expected = compress_parts([samples], plain, chunk=700, threads=1)
    multiplied, grams = list[int](), CompiledChunk.grams

    def counted(*args: Any) -> Iterator[object]:
        multiplied.append(len(made := list(grams(*args))))
        return iter(made)

    monkeypatch.setattr(CompiledChunk, "grams", counted)
    found = compress_parts([samples], fast, chunk=700, threads=1)
    assert multiplied[0] == 0 < multiplied[1] == multiplied[2] == multiplied[3]
    assert_same_factors(found[0].factor, expected[0].factor)


def test_rows_unlike_those_before_are_made_again_and_factorized(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that holds a pose, and then moves."""
    plain, fast = builders(QUADRUPED, POINTS, sensor_set("joints", QUADRUPED, POINTS))
    samples = random_samples(QUADRUPED, POINTS, 9000, 9, states=1)[0]
    still = torch.ones(9000, 1, dtype=torch.float64)
    still[:6000] = 1e-7
    motion = {
        f"joint_{name}": getattr(samples, f"joint_{name}") * still for name in ("position", "velocity", "acceleration")
    }
    base = {name: getattr(samples.base, name) * still for name in ("angular_velocity", "angular_acceleration")}
    samples = replace(samples, base=replace(samples.base, **base), **motion)
    refused, add_gram = list[bool](), row_compressor.RowCompressor.add_gram

    def counted(*args: object) -> bool:
        refused.append(not (added := add_gram(*args)))
        return added

    monkeypatch.setattr(row_compressor.RowCompressor, "add_gram", counted)
    with without_kernels():
        expected = compress_parts([samples], plain, chunk=3000, threads=1)
    found = compress_parts([samples], fast, chunk=3000, threads=1)
    assert any(refused)
    assert_same_factors(found[0].factor, expected[0].factor)


@pytest.mark.parametrize("sensors", ["joints", "mixed"])
def test_extra_parameters_of_joints_are_in_the_rows(sensors: str) -> None:
    actuators = dict.fromkeys(("armature", "stiffness", "asymmetric_coulomb", "torque_offset"), True)
    terms = ExtraTerms(**actuators, scales={"joint_torque": (("front_*",), ("rear_*",))}, stribeck=0.1, slope=True)
    plain, fast = builders(QUADRUPED, POINTS, sensor_set(sensors, QUADRUPED, POINTS), terms)
    samples = random_samples(QUADRUPED, POINTS, 300, 8, states=3)[0]
    assert assert_same_rows(plain, fast, samples) == len(list(chunks_by_state(samples)))
    of_contacts = ExtraTerms(offsets={"contact_force": "all"})
    other = RowBuilder(QUADRUPED, POINTS, sensor_set(sensors, QUADRUPED, POINTS), of_contacts)
    choose_kernels(other, MANY)
    assert (other.compiled is None) == bool(other.extras), "torch's"


@pytest.mark.parametrize("turns", [1e4, 1e7])
def test_joints_may_turn_many_times(turns: float) -> None:
    plain, fast = builders(QUADRUPED, POINTS, sensor_set("full", QUADRUPED, POINTS))
    samples = random_samples(QUADRUPED, POINTS, 100, 6, states=1)[0]
    samples = replace(samples, joint_position=turns * samples.joint_position)
    assert assert_same_rows(plain, fast, samples) == 1


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


@pytest.mark.parametrize("sensors", ["joints", "full"])
def test_fits_without_the_library_are_the_same(sensors: str) -> None:
    builder = RowBuilder(QUADRUPED, POINTS, sensor_set(sensors, QUADRUPED, POINTS))
    samples = random_samples(QUADRUPED, POINTS, 5000, 7, states=2)[0]
    found = compress([samples], builder).triangle()
    assert builder.compiled is not None
    with without_kernels():
        expected = compress([samples], builder).triangle()
        assert builder.compiled is None
        with pytest.warns(torchid.errors.TorchidWarning, match="compression takes twice as long"):
            choose_kernels(builder, MANY)
    assert_same_grams(found, expected)


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
