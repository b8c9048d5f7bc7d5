"""The benchmark's stages: floors that are counted right, and one line where there is no GPU."""

from __future__ import annotations

import pytest
import torch
from benchmark import main
from random_samples import random_samples, sensor_set
from repository import DEMO
from stages import STAGES, Limits, Need, measure_stages, needs, stage_table
from synthetic import load

from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state
from torchid.sensing import Contact

CPU = torch.device("cpu")
LIMITS = Limits(operations=1e9, copied=8e9, uploaded=None)


@pytest.fixture(scope="module")
def quadruped() -> tuple[RowBuilder, Samples]:
    robot = load(DEMO / "quadruped.urdf")
    contacts = [Contact(f"{leg}_foot", "point") for leg in ("front_left", "front_right", "rear_left", "rear_right")]
    samples, _ = random_samples(robot, contacts, 64, 2, states=1)
    samples.active[:] = torch.ones(4, dtype=torch.bool)
    return RowBuilder(robot, contacts, sensor_set("joints", robot, contacts)), samples


def test_the_floor_is_the_time_of_a_product_and_of_a_copy() -> None:
    assert LIMITS.floor(Need(operations=2e9, numbers=3e9)) == pytest.approx(5.0)


def test_needs_are_those_of_the_equations_and_grow_with_the_samples(quadruped: tuple[RowBuilder, Samples]) -> None:
    builder, samples = quadruped
    one, half = ([(part, state) for state, _ in chunks_by_state(part)] for part in (samples, samples[:32]))
    whole = needs(builder, one)
    for found, of_half in zip(whole, needs(builder, half), strict=True):
        assert found.operations == pytest.approx(2.0 * of_half.operations)
        assert found.numbers == pytest.approx(2.0 * of_half.numbers)
    rows, width = 64 * (18 - 12), builder.width + 1  # all legs stand: six rows, in all columns
    assert whole[3].operations == 2 * rows * width**2
    assert whole[1].operations == pytest.approx(
        64 * (12 * 12 * 18 + 2 * 18 * 144 - 2 * 12**3 / 3 + 4 * 18 * 6 * 12 - 2 * 6 * 144)
    )


def test_every_stage_of_a_compression_is_measured_beside_its_floor(quadruped: tuple[RowBuilder, Samples]) -> None:
    builder, samples = quadruped
    stages = measure_stages(builder, samples, LIMITS)
    assert tuple(stages.measured) == tuple(stages.floor) == STAGES
    assert all(floor > 0.0 for floor in stages.floor.values())
    assert stages.measured[STAGES[0]] > 0.0
    table = stage_table({"quadruped": stages}, LIMITS, CPU)
    assert table.row_count == len(STAGES) + 1


def test_limits_of_this_machine_are_those_of_some_machine() -> None:
    limits = Limits.of(CPU)
    assert 1e8 < limits.operations < 1e13
    assert 1e8 < limits.copied < 1e13
    assert limits.uploaded is None


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark.py", "--device", "cuda"])
    with pytest.raises(SystemExit) as ended:
        main()
    (line,) = str(ended.value).splitlines()
    assert "found no GPU" in line
