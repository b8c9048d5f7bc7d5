"""Commands in processes of their own, that can be killed, starved of disk space, or run side by side."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from run_figures import FIGURES

_SERVER = """
import gc, json, os, resource, signal, sys
import h5py, jinja2, scipy.signal, torch._dynamo, torchid.commands.results, torchid.commands.evaluate, torchid.commands.analyze, torchid.commands.check
import torchid.commands.compress, torchid.commands.identify, torchid.estimators.training, torchid.report.page, torchid.report.tensorboard
import torchid.terminal.analysis, torchid.terminal.runs, torchid.terminal.identification
from matplotlib.figure import Figure
from torchid.cli import main
for module in (torchid.commands.run_figures, torchid.commands.evaluate, torchid.commands.analyze):
    for name in FIGURES:
        if hasattr(module, name):
            setattr(module, name, lambda *_, **__: Figure(figsize=(1.0, 1.0)))
torchid.report.page._library()  # compressed once for all children
gc.freeze()
signal.signal(signal.SIGINT, signal.default_int_handler)
said = {}
"x".encode("cp437")  # which zipfile loads late, when another user may not read it
print("ready", flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    if "wait" in asked:
        with os.fdopen(said.pop(asked["wait"]), errors="replace") as pipe:
            lines = pipe.read().splitlines()
        status = os.waitstatus_to_exitcode(os.waitpid(asked["wait"], 0)[1])
        print(json.dumps([status, lines]), flush=True)
        continue
    read, write = os.pipe()
    child = os.fork()
    if child:
        os.close(write)
        said[child] = read
        print(child, flush=True)
        continue
    os.dup2(write, 2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    if asked["uid"]:
        os.setgid(asked["uid"]), os.setuid(asked["uid"])
    if asked["largest"] is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (asked["largest"],) * 2)
    try:
        status = main(asked["arguments"])
        sys.stderr.flush()
    except KeyboardInterrupt:  # before the command had begun
        status = 1
    os._exit(status)
"""


@dataclass(frozen=True)
class Ended:
    """How a command ended: its exit status (-9 if killed), and what it said on standard error, warnings aside."""

    status: int
    said: list[str]


class Commands:
    """A process that has everything loaded, and runs each command in a child; figures are empty."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def start(self, arguments: list[str], largest: int | None = None, uid: int = 0) -> int:
        """Start a command whose files may have `largest` bytes, as another user; its process."""
        return int(self._ask({"arguments": arguments, "largest": largest, "uid": uid}))

    def end(self, child: int) -> Ended:
        """Wait for a command."""
        status, lines = self._ask({"wait": child})
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

    def _ask(self, asked: dict[str, object]) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


@contextmanager
def commands() -> Iterator[Commands]:
    """The process, until the block ends."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    program = f"FIGURES = {FIGURES}\n{_SERVER}"
    with subprocess.Popen([sys.executable, "-c", program], text=True, **pipes) as process:  # type: ignore[call-overload]
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield Commands(process)
        process.stdin.close()
