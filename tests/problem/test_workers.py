"""Workers that share the chunks of a log."""

from __future__ import annotations

import time

import pytest
import torch
from synthetic import SOLO12, load

from torchid.problem import RowBuilder
from torchid.problem.chunks import run_in_workers
from torchid.sensing import Contact, named_sensors


def test_a_failure_of_one_worker_stops_the_others_at_their_next_task() -> None:
    done = []

    def run(tasks: object) -> None:
        for task in tasks:
            if task == 1:
                raise RuntimeError("broken")
            time.sleep(0.02)
            done.append(task)

    with pytest.raises(RuntimeError, match="broken"):
        run_in_workers(range(200), run, 2)
    assert len(done) < 20


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_is_done_once_with_one_thread_each_and_without_gradients(workers: int) -> None:
    before = torch.get_num_threads()

    def run(tasks: object) -> list[tuple[int, int, bool]]:
        return [(task, torch.get_num_threads(), torch.is_grad_enabled()) for task in tasks]

    found = sorted(x for part in run_in_workers(range(7), run, workers) for x in part)
    assert found == [(task, 1, False) for task in range(7)]
    assert torch.get_num_threads() == before


def test_a_builder_that_moves_makes_its_plans_anew() -> None:
    robot = load(SOLO12)
    builder = RowBuilder(robot, [Contact("FL_FOOT", "point")], named_sensors("joints", robot.n, 1))
    assert builder.layout((True,)).row_std.dtype == torch.float64
    assert builder.float().layout((True,)).row_std.dtype == torch.float32
