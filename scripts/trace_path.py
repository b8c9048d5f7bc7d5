"""Which files and functions of torchid run between a log file and the parameters fitted to it?

    python scripts/trace_path.py                        # the experiment that comes with torchid
    python scripts/trace_path.py my.yaml --functions    # another one, with functions in order of first calls

Three paths:
- identify: `torchid identify` as a whole, from the command line to the run folder;
- log to phi: the part of it from the first call into `torchid/logs` until the parameters that it returns exist;
- library: from `read_log` to `LeastSquares.solve` by the calls of docs/python.md, with the stated noise and
  without checks.

Named functions are counted; lambdas, comprehensions and what runs while modules are imported are not.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from types import FrameType
from typing import Any

import yaml

import torchid
from torchid.cli import main as command_line

PACKAGE = Path(torchid.__file__).parent


class Trace:
    """Calls of torchid's own functions: (file, line, name, depth of the call), in order, over all threads."""

    def __init__(self, calls: Sequence[tuple[str, int, str, int]] = ()) -> None:
        """Start with some calls."""
        self.calls = list(calls)
        self.estimates: list[tuple[object, int]] = []  # objects with phi, and the number of calls before each
        self.identified: Any = None  # what the function `identify` returned

    def run(self, action: Callable[[], object]) -> Trace:
        """Trace an action."""
        threading.setprofile(self._event)
        sys.setprofile(self._event)
        try:
            action()
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
        return self

    def from_log(self) -> Trace:
        """The part from the first call into `torchid/logs` until the parameters that `identify` returned, if it ran."""
        start = next(number for number, call in enumerate(self.calls) if call[0].startswith("logs"))
        found = getattr(getattr(self.identified, "estimate", None), "phi", None)
        ends = [count for made, count in self.estimates if found is not None and getattr(made, "phi", None) is found]
        return Trace(self.calls[start : min(ends, default=len(self.calls))])

    def __str__(self) -> str:
        """Numbers of files, functions and calls."""
        files, functions = {call[0] for call in self.calls}, {call[:3] for call in self.calls}
        return f"{len(files):4} files {len(functions):5} functions {len(self.calls):8} calls"

    def functions(self) -> list[str]:
        """A line for each function in the order of first calls, indented by the depth of that call."""
        top, first = min(depth for *_, depth in self.calls), dict[tuple[str, int, str], int]()
        for file, line, name, depth in self.calls:
            first.setdefault((file, line, name), depth)
        return [f"{'  ' * (depth - top)}{name}  ({file}:{line})" for (file, line, name), depth in first.items()]

    def _event(self, frame: FrameType, event: str, arg: Any) -> None:
        code = frame.f_code
        if event not in ("call", "return") or not code.co_filename.startswith(str(PACKAGE)):
            return
        if event == "call" and not code.co_name.startswith("<"):
            path = str(Path(code.co_filename).relative_to(PACKAGE))
            self.calls.append((path, code.co_firstlineno, code.co_name, _depth(frame)))
        elif event == "return":
            held = getattr(arg, "__dict__", {})
            if "phi" in held:
                self.estimates.append((arg, len(self.calls)))
            if code.co_name == "identify" and "estimate" in held:
                self.identified = arg


def _depth(frame: FrameType | None) -> int:
    """Number of torchid's own frames on the stack."""
    depth = 0
    while frame is not None:
        depth += frame.f_code.co_filename.startswith(str(PACKAGE))
        frame = frame.f_back
    return depth


def import_everything() -> None:
    """Import all modules whose libraries are installed, so that no import is traced."""
    for module in pkgutil.walk_packages([str(PACKAGE)], "torchid."):
        if not module.name.endswith("__main__"):
            with suppress(ImportError):
                importlib.import_module(module.name)


def library_path(file: Path) -> None:
    """From the first training log of an experiment file to phi by the calls of docs/python.md."""
    settings = yaml.safe_load(file.read_text())
    sensors = settings["sensors"]
    chosen = sensors if isinstance(sensors, str) else sensors["set"]
    robot = torchid.load_robot(file.parent / settings["robot"]["urdf"])
    contacts = [torchid.Contact(contact["frame"], contact["type"]) for contact in settings.get("contacts", [])]
    sensor_set = torchid.named_sensors(chosen, robot.n, len(contacts))
    log = torchid.preprocess(
        torchid.read_log(file.parent / settings["logs"]["train"][0]), **settings.get("preprocessing", {})
    )
    samples = torchid.bind_log(log, robot, contacts, required=sensor_set)
    builder = torchid.RowBuilder(robot, contacts, sensor_set)
    problem = torchid.linear_problem(torchid.compress([samples], builder), builder, robot)
    torchid.Consistent(ridge=0.01).solve(problem)


def main() -> int:
    """Trace and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, default=PACKAGE / "demo" / "quadruped.yaml")
    parser.add_argument("--functions", action="store_true", help="list the functions of each path")
    options = parser.parse_args()
    import_everything()
    print(f"torchid        {len(list(PACKAGE.rglob('*.py'))):4} files in all")
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
        arguments = ["identify", str(options.file), f"output={folder}/run"]
        whole = Trace().run(lambda: command_line(arguments))
    if whole.identified is None:
        return 1  # the command has printed the reason
    paths = {"identify": whole, "log to phi": whole.from_log()}
    with suppress(KeyError):  # the experiment file uses keys that these calls do not support
        paths["library"] = Trace().run(lambda: library_path(options.file)).from_log()
    for name, trace in paths.items():
        print(f"{name:14} {trace}")
        if options.functions:
            print("\n".join(f"    {line}" for line in trace.functions()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
