"""The benchmark's stages: floors that are counted right, and one line where there is no GPU."""

from __future__ import annotations

import pytest
import torch
from benchmark import main
from random_samples import random_samples, sensor_set
from repository import DEMO
from stages import STAGES, Limits, measure_stages, stage_table
from synthetic import load

from torchid.problem import RowBuilder, Samples
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


def test_every_stage_of_a_compression_is_measured_beside_its_floor(quadruped: tuple[RowBuilder, Samples]) -> None:
    builder, samples = quadruped
    stages = measure_stages(builder, samples, LIMITS)
    assert tuple(stages.measured) == tuple(stages.floor) == STAGES
    assert all(floor > 0.0 for floor in stages.floor.values())
    assert stages.measured[STAGES[0]] > 0.0
    table = stage_table({"quadruped": stages}, LIMITS, CPU)
    assert table.row_count == len(STAGES) + 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark.py", "--device", "cuda"])
    with pytest.raises(SystemExit) as ended:
        main()
    (line,) = str(ended.value).splitlines()
    assert "found no GPU" in line
