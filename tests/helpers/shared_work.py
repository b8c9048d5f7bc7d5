"""Experiments of three robots for processes that share the work, and the commands that start these."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from socket import socket
from tempfile import TemporaryFile
from typing import Any, NoReturn

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[2]
TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node")
TWO = (*TORCHRUN, "2")
SMALL_CHUNK = 64
RANDOM = {"noise": {"joint_torque": 0.1, "contact_force": 0.5, "contact_moment": 0.05}}


def write_experiments(folder: Path) -> dict[str, Path]:
    """Experiment files of a quadruped, a bolted arm and a biped with offsets of its own in each of two logs.

    The arm's log has folds of more than one chunk of `SMALL_CHUNK` samples, so that processes share them; the biped's
    are short.
    """
    from demo import NO_TERMS
    from synthetic import PANDA, Oracle, load, make_log

    from torchid.logs import write_log

    demo = ROOT / "torchid" / "demo"
    feet = [f"{leg}_foot" for leg in ("front_left", "front_right", "rear_left", "rear_right")]
    walks = [[True] * 4, [True, False, False, True], [False, True, True, False]]
    robots: dict[str, Any] = {
        "quadruped": (demo / "quadruped.urdf", False, [(foot, 3) for foot in feet], walks, [150], "joints"),
        "arm": (PANDA, True, [], [[]], [200], "joints"),
        "biped": (
            ROOT / "configs" / "biped.urdf",
            False,
            [("l_sole", 6), ("r_sole", 6)],
            [[True, True], [True, False], [False, True]],
            [80, 70],
            {"set": "full", "offsets": {"contact_force": "log", "contact_moment": "log"}},
        ),
    }
    out = {}
    for name, (urdf, bolted, contacts, states, counts, sensors) in robots.items():
        (folder / name).mkdir(parents=True)
        rng = np.random.default_rng(3)
        oracle = Oracle.of(load(urdf, None, bolted))
        oracle.perturb(rng, 0.1)
        files = []
        for number, count in enumerate(counts):
            log = make_log(oracle, contacts, states, count, rng, tilt=None if bolted else 0.2)
            assert log.joint_torque is not None
            changed: dict[str, Any] = {"joint_torque": log.joint_torque + 0.1 * rng.normal(size=log.joint_torque.shape)}
            changed["joint_torque"][::50, 0] += 20.0  # for robust losses
            if contacts and log.contact_wrench_local is not None:
                bias = rng.normal(size=log.contact_wrench_local.shape[1:])
                changed["contact_wrench_local"] = log.contact_wrench_local + bias
            files.append(f"log{number}.npz")
            write_log(replace(log, **changed), folder / name / files[-1])
        document = {
            "robot": {"urdf": str(urdf), "fixed_base": bolted},
            "contacts": [{"frame": frame, "type": "point" if size == 3 else "flat"} for frame, size in contacts],
            "logs": {"train": files},
            "sensors": (sensors if isinstance(sensors, dict) else {"set": sensors}) | RANDOM,
            "actuators": NO_TERMS,
            "estimator": {"name": "least_squares", "ridge": 1e-3},
            "output": str(folder / name / "run"),
        }
        out[name] = folder / name / "experiment.yaml"
        out[name].write_text(yaml.safe_dump(document))
    return out


@contextmanager
def started(command: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """A command with one thread a process, its output kept; whatever it has started ends with the block."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "helpers")])
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        [*command], env=environment, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        for group in (*children(process), process.pid):  # torchrun gives each of them a session of its own
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(group, signal.SIGKILL)
        with suppress(ValueError):  # both streams are read already
            process.communicate()


def children(process: subprocess.Popen[str]) -> list[int]:
    """The processes that a process has started."""
    with suppress(OSError):
        return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]
    return []


def is_running(pid: int) -> bool:
    """Whether a process has not ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def finish(command: Sequence[str]) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a command."""
    with started(command) as process:
        printed, complained = process.communicate(timeout=400)
    return process.returncode, printed, complained


def finish_forked(
    processes: int,
    run: Callable[[], int],
    folders: Sequence[Path] = (),
    meanwhile: Callable[[Sequence[int]], None] = lambda _: None,
) -> tuple[int, str, str]:
    """`finish` of what forks of this process run, in which everything is set that torchrun sets.

    They have nothing to import, and nobody ends those that another one leaves behind, unless `meanwhile` does, which is
    given the processes. Each may have a folder of its own to work in. The status is the one of theirs farthest from 0.
    """
    with socket() as free:
        free.bind(("localhost", 0))
        common = {"WORLD_SIZE": str(processes), "MASTER_ADDR": "localhost", "MASTER_PORT": str(free.getsockname()[1])}
    with TemporaryFile("w+") as printed, TemporaryFile("w+") as complained:
        pids = []
        for rank in range(processes):
            pid = os.fork()
            if pid == 0:
                os.environ.update(common | {"RANK": str(rank), "LOCAL_RANK": str(rank)})
                os.chdir(folders[rank] if folders else ".")
                become(run, printed.fileno(), complained.fileno())
            pids.append(pid)
        try:
            meanwhile(pids)
            statuses = [_status_of(pid) for pid in pids]
        finally:
            for pid in pids:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        texts = []
        for stream in (printed, complained):
            stream.seek(0)
            texts.append(stream.read())
    return max(statuses, key=abs), texts[0], texts[1]


def become(run: Callable[[], int], printed: int, complained: int) -> NoReturn:
    """Run something in this process, whose streams are files, and end with its status."""
    status = 70
    try:
        for own, (name, file) in zip((1, 2), (("stdout", printed), ("stderr", complained)), strict=True):
            os.dup2(file, own)
            setattr(sys, name, os.fdopen(own, "w", buffering=1, closefd=False))
        warnings.resetwarnings()  # of pytest, which makes errors of them
        status = run()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _status_of(pid: int, timeout: float = 60.0) -> int:
    """Exit status of a child once it has ended by itself.

    Raises:
        TimeoutError: it has not.
    """
    until = time.monotonic() + timeout
    while time.monotonic() < until:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    raise TimeoutError(f"a process goes on after {timeout:.0f} s")


def run_all(processes: int, folder: Path, runs: Sequence[tuple[str, Path, Sequence[str]]]) -> None:
    """Run experiments by name, file and overrides in this process or some forks, each into the folder of its name."""
    jobs = folder / "jobs.json"
    folder.mkdir(parents=True)
    jobs.write_text(json.dumps([[name, str(file), [*more]] for name, file, more in runs]))
    if processes == 1:
        with one_thread():
            _identify_all(jobs)
        return
    from torch.multiprocessing import start_processes

    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of forks, here of a process whose threads are idle
        start_processes(_identify_together, (processes, jobs), processes, start_method="fork")


@contextmanager
def one_thread() -> Iterator[None]:
    """As processes have that torchrun starts, where the tests have more."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def differences(one: Any, other: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Relative differences of all numbers of two documents, by place; infinite where anything else differs."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        for key in one.keys() - {"seconds"}:
            yield from differences(one[key], other[key], f"{path}.{key}")
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for number, (x, y) in enumerate(zip(one, other, strict=True)):
            yield from differences(x, y, f"{path}.{number}")
    elif isinstance(one, float) and isinstance(other, float):
        yield path, abs(one - other) / max(abs(one), abs(other), 1e-300)
    else:
        yield path, 0.0 if one == other else float("inf")


def _identify_all(jobs: Path) -> None:
    from torchid.commands.identify import identify
    from torchid.config import load_config
    from torchid.distributed import share_work

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, file, more in json.loads(jobs.read_text()):
            with share_work():
                identify(load_config(file, [*more, f"output={jobs.parent / name}"]))


def _identify_together(rank: int, processes: int, jobs: Path) -> None:
    """One of some processes, forked with all that they import."""
    import torch.distributed as dist  # noqa: TID251

    meet = f"file://{jobs.with_name('rendezvous')}"
    dist.init_process_group("gloo", init_method=meet, rank=rank, world_size=processes)
    _identify_all(jobs)


def lines_of_torchid(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("torchid: ") and "Warning" not in line]
