"""Workers that share the chunks of a log."""

from __future__ import annotations

import time

import pytest
import torch
from random_samples import random_samples
from synthetic import SOLO12, load
from threadpoolctl import threadpool_info

from torchid.parallel import one_thread, run_in_workers, thread_count
from torchid.problem import RowBuilder
from torchid.problem.chunks import chunks_by_state, worker_count
from torchid.sensing import Contact, named_sensors


def test_a_failure_of_one_worker_stops_the_others_at_their_next_task() -> None:
    done = []

    def run(tasks: object) -> None:
        for task in tasks:
            if task == 1:
                raise RuntimeError("broken")
            time.sleep(0.1)  # in which the other fails, however busy the machine is
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


def test_each_worker_gets_as_many_chunks_of_a_state_and_no_chunk_is_split_for_it() -> None:
    samples, _ = random_samples(load(SOLO12), [Contact("FL_FOOT", "point")], 100, 0, states=1)
    for chunk, expected in ((100, [100]), (60, [50, 50]), (40, [25] * 4)):
        sizes = [len(samples[index]) for _, index in chunks_by_state(samples, chunk, workers=2)]
        assert sizes == expected


def test_a_block_with_one_thread_has_one_in_linear_algebra_and_as_many_workers_as_before() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with one_thread():
            with one_thread():
                pass
            assert torch.get_num_threads() == 1
            assert {x["num_threads"] for x in threadpool_info() if is_blas(x)} == {1}
            assert thread_count() == worker_count(torch.device("cpu")) == 2
            found = run_in_workers(range(2), lambda tasks: [torch.get_num_threads() for _ in tasks], 2)
            assert found == [[1], [1]]
        assert torch.get_num_threads() == thread_count() == 2
    finally:
        torch.set_num_threads(before)


def is_blas(pool: dict[str, object]) -> bool:
    return pool["user_api"] == "blas"


def test_a_builder_that_moves_makes_its_plans_anew() -> None:
    robot = load(SOLO12)
    builder = RowBuilder(robot, [Contact("FL_FOOT", "point")], named_sensors("joints", robot.n, 1))
    assert builder.layout((True,)).row_std.dtype == torch.float64
    assert builder.float().layout((True,)).row_std.dtype == torch.float32
