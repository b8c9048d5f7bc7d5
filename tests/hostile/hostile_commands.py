"""Commands in processes of their own, that can be killed, starved of disk space, or run side by side."""

from __future__ import annotations

import gc
import os
import resource
import signal
import time
from dataclasses import dataclass
from importlib import import_module

import pytest
import torch
from run_figures import EVENTS, PAGE, draw
from shared_work import become

from torchid.cli import main

_LATE = [
    *("h5py", "jinja2", "scipy.signal", "torch._dynamo", "torchid.estimators.training", "torchid.report.tensorboard"),
    *(f"torchid.commands.{name}" for name in ("check", "compress", "identify")),
    *(f"torchid.terminal.{name}" for name in ("analysis", "identification")),
]
"""What commands import when they need it, and another user may not read."""

_BEGINS = b"-"  # what a process says from when on it may be stopped


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit status (-9 if killed), and what it said on standard error, warnings aside."""

    status: int
    said: list[str]


class Commands:
    """Runs each command in a fork of this process, which has everything loaded; figures are empty."""

    def __init__(self) -> None:
        for name in _LATE:
            import_module(name)
        "x".encode("cp437")  # which zipfile loads late
        self._said: dict[int, int] = {}

    def start(self, arguments: list[str], largest: int | None = None, uid: int = 0) -> int:
        """Start a command whose files may have `largest` bytes, as another user; its process."""

        def run() -> int:
            gc.freeze()
            torch.set_num_threads(1)  # the threads of this process are not in its forks
            draw(pytest.MonkeyPatch(), (PAGE, EVENTS))
            if uid:
                os.setgid(uid)
                os.setuid(uid)
            if largest is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (largest,) * 2)
            try:
                os.write(write, _BEGINS)
                return main(arguments)
            except KeyboardInterrupt:  # before the command had begun
                return 1
            finally:
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # or it would go on as a run of tests

        read, write = os.pipe()
        child = os.fork()
        if not child:
            become(run, os.open(os.devnull, os.O_WRONLY), write)
        os.close(write)
        os.read(read, len(_BEGINS))
        self._said[child] = read
        return child

    def end(self, child: int) -> Ended:
        """Wait for a command."""
        with os.fdopen(self._said.pop(child), errors="replace") as pipe:
            lines = pipe.read().splitlines()
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return Ended(status, [line for line in lines if "Warning: " not in line[:60]])

    def run(self, arguments: list[str], largest: int | None = None, uid: int = 0) -> Ended:
        """Run a command to its end."""
        return self.end(self.start(arguments, largest, uid))

    def stopped(self, arguments: list[str], number: signal.Signals, after: float) -> Ended:
        """Send a signal so many seconds after the start."""
        child = self.start(arguments)
        time.sleep(after)
        os.kill(child, number)  # a child that has ended waits to be waited for
        return self.end(child)
