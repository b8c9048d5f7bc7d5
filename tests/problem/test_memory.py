"""Memory of a fit: that of the log's arrays and a constant, however long the log."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from repository import DEMO

URDF = DEMO / "quadruped.urdf"
FIT = """
import json, os, sys, torch, torchid
from torchid.problem import Samples
from torchid.problem.motion import BaseMotion
for count in map(int, sys.argv[2:]):
    if not (child := os.fork()):  # which has nothing to import
        break
    os.waitpid(child, 0)
else:
    os._exit(0)
robot = torchid.load_robot(sys.argv[1])
contacts = [torchid.Contact(f"{leg}_foot", "point") for leg in ("front_left", "front_right", "rear_left", "rear_right")]
generator = torch.Generator().manual_seed(0)
normal = lambda *shape: torch.randn(count, *shape, generator=generator, dtype=torch.float64)
base = BaseMotion(torch.nn.functional.normalize(normal(4)), normal(3), normal(3), normal(3))
time, active = torch.arange(count, dtype=torch.float64), torch.rand(count, 4, generator=generator) < 0.9
samples = Samples("random", time, normal(12), normal(12), normal(12), base, normal(12), None, False, active)
peak = lambda: next(int(line.split()[1]) for line in open("/proc/self/status") if line[:6] == "VmHWM:") / 1024.0
arrays = peak()
builder = torchid.RowBuilder(robot, contacts, torchid.named_sensors("joints", robot.n, 4))
factor = torchid.compress([samples], builder, threads=2)
estimate = torchid.LeastSquares().solve(torchid.linear_problem(factor, builder, robot))
print(json.dumps({"arrays": arrays, "all": peak(), "rows": factor.rows, "rank": estimate.rank}), flush=True)
os._exit(0)
"""


def fits(*counts: int) -> list[dict[str, float]]:
    """Peak resident memory [MiB] before and after joints-only fits of an 18-dof quadruped, each in a process."""
    command = [sys.executable, "-c", FIT, str(URDF), *map(str, counts)]
    lines = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()
    found: list[dict[str, float]] = [*map(json.loads, lines)]
    assert [one["rank"] for one in found] == [118] * len(counts)
    assert all(one["rows"] >= 6 * count for one, count in zip(found, counts, strict=True))
    return found


def test_five_times_the_samples_need_no_more_memory_beside_their_arrays() -> None:
    short, long = fits(38_000, 190_000)  # both in chunks of the largest size
    assert long["all"] - long["arrays"] < short["all"] - short["arrays"] + 80.0  # allocators keep some slack


@pytest.mark.study
def test_a_million_samples_of_a_quadruped_fit_in_two_gibibytes() -> None:
    assert fits(1_000_000)[0]["all"] < 2048.0
