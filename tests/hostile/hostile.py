"""What every answer to a hostile file must be: soon, one line, in bounded memory, with nothing written and nothing run."""

from __future__ import annotations

import io
import os
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchid.errors import BaseLostError, InputError, TorchidWarning, is_plain
from torchid.reader import LIMITS

os.environ.setdefault(LIMITS, "0.25")  # of cases that never end
WORK_SECONDS = 5.0
"""Processor time of a case, which other processes do not prolong."""
WAITING_SECONDS = 30.0
"""Until a case that waits is given up."""
GROWTH_BYTES = 2**30
LONGEST_LINE = 3000
_ADDRESS_SPACE_BYTES = 6 * 2**30  # what a case may reserve beyond what there is: a bomb that goes off ends here
_CLEAR_PEAK = Path("/proc/self/clear_refs")
_STATUS = Path("/proc/self/status")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod")
_FOLDER_ARGUMENT = {"os.mkdir": 2, "os.remove": 1, "os.rmdir": 1, "os.chmod": 2, "os.rename": 2, "os.link": 2}
_FOLDER_ARGUMENT |= {"os.symlink": 2}
_RUNS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pickle.find_class")
_CALLS = ("socket.connect", "socket.getaddrinfo", "urllib.Request", "ftplib.connect", "http.client.connect")
_OUR_WARNINGS = "|".join(kind.__name__ for kind in (TorchidWarning, *TorchidWarning.__subclasses__()))
_HARMLESS = (TorchidWarning, DeprecationWarning, PendingDeprecationWarning)


class TooSlowError(BaseException):
    """Nothing may catch it."""


@dataclass
class Verdict:
    """What became of one case: "refused" (as bad input), "failed" (exit status 1) or "accepted", and what is wrong."""

    name: str
    outcome: str = "accepted"
    message: str = ""
    growth: int = 0  # bytes
    faults: list[str] = field(default_factory=list)


@dataclass
class Tally:
    """Verdicts of one kind of case."""

    kind: str
    verdicts: list[Verdict] = field(default_factory=list)

    @property
    def faults(self) -> list[str]:
        """One line for each case that went wrong."""
        return [f"{self.kind}, {x.name}: {fault}" for x in self.verdicts for fault in x.faults]

    @property
    def accepted(self) -> list[str]:
        """Names of the cases that were read."""
        return [x.name for x in self.verdicts if x.outcome == "accepted"]

    def share(self, outcome: str) -> float:
        """Of the cases that ended so."""
        return sum(x.outcome == outcome for x in self.verdicts) / len(self.verdicts)


class _Watch:
    """What the interpreter does to the world while it is on."""

    def __init__(self) -> None:
        self.on = False
        self.events: list[str] = []
        self.allowed: list[str] = []
        sys.addaudithook(self)

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        if not self.on:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & _WRITING and not self._may(path):
                self.events.append(f"opened {path} for writing")
        elif event == "os.mkdir" and os.path.isdir(str(arguments[0])):
            pass  # which changes nothing
        elif event in _CHANGES:
            place = _FOLDER_ARGUMENT.get(event)
            if not self._may(arguments[0], -1 if place is None else arguments[place]):
                self.events.append(f"{event} {arguments[0]}")
        elif event == "subprocess.Popen" and "torchid.reader" in str(arguments[1]):
            pass  # the process that reads
        elif event in _RUNS or event in _CALLS:
            self.events.append(f"{event} {arguments[:2]}")

    def _may(self, path: object, folder: object = -1) -> bool:
        """Whether a path, relative to an open folder if there is one, may be written."""
        if not isinstance(path, (str, bytes, os.PathLike)):
            return True  # a descriptor: opened before
        above = os.readlink(f"/proc/self/fd/{folder}") if isinstance(folder, int) and folder >= 0 else ""
        full = os.path.abspath(os.path.join(above, os.fsdecode(path)))
        if "__pycache__" in full.split(os.sep)[-2:]:
            return True  # the interpreter's own, of a module that nobody has imported before
        return any(full.startswith(start) for start in (*self.allowed, os.devnull))


_watch = _Watch()


def judged(name: str, call: Callable[[], object], folder: Path, may_write: Iterable[Path] = ()) -> Verdict:
    """Run one case, which may change nothing in a folder but what stands under `may_write`.

    Args:
        name: of the case.
        call: reads the file, or runs a command and returns its exit status.
        folder: what is compared before and after; working and temporary folders lie in it.
        may_write: files and folders that a command may write.
    """
    verdict = Verdict(name)
    allowed = [str(path) for path in may_write]
    before = _listing(folder, allowed)
    printed = io.StringIO()
    _watch.events.clear()
    _watch.allowed = allowed
    rested = _clear_peak()
    start = time.process_time()
    try:
        with (
            _limits(),
            _elsewhere(folder),
            warnings.catch_warnings(record=True) as caught,
            redirect_stdout(io.StringIO()),
            redirect_stderr(printed),
        ):
            warnings.simplefilter("always")
            _watch.on = True
            _settle(verdict, call(), printed)
    except (InputError, BaseLostError) as error:
        verdict.outcome = "refused"
        verdict.message = str(error)
    except TooSlowError:
        verdict.faults.append(f"not done after {WORK_SECONDS:g} s")
    except Exception as error:  # noqa: BLE001 - this is what is looked for
        verdict.faults.append(f"raised {type(error).__name__}: {str(error)[:300]}")
    finally:
        _watch.on = False
        seconds = time.process_time() - start
        verdict.growth = max(0, _peak() - rested)
    verdict.faults += dict.fromkeys(_watch.events)
    for warning in caught:
        if not issubclass(warning.category, _HARMLESS) or not is_plain(str(warning.message)):
            verdict.faults.append(f"warned {warning.category.__name__}: {warning.message!r}")
    verdict.faults += [f"left {path}" for path in sorted(_listing(folder, allowed) ^ before)]
    verdict.faults += _complaints(verdict)
    if seconds > WORK_SECONDS:
        verdict.faults.append(f"took {seconds:.1f} s")
    return verdict


def examined(
    kind: str,
    cases: Iterable[tuple[str, Any]],
    call: Callable[[Any], object],
    folder: Path,
    may_write: Iterable[Path] = (),
) -> Tally:
    """What became of every case of a kind, given to a call."""
    allowed = tuple(may_write)
    return Tally(kind, [judged(name, lambda case=case: call(case), folder, allowed) for name, case in cases])


def _settle(verdict: Verdict, status: object, printed: io.StringIO) -> None:
    """Take a command's exit status and what it said on standard error, warnings aside."""
    if not isinstance(status, int) or isinstance(status, bool):
        return
    lines = [line for line in printed.getvalue().splitlines() if not re.match(rf"torchid: ({_OUR_WARNINGS}): ", line)]
    verdict.outcome = {0: "accepted", 1: "failed", 2: "refused"}[status]
    verdict.message = "\n".join(lines)
    if status == 1 or bool(lines) != bool(status) or (lines and not verdict.message.startswith("torchid: ")):
        verdict.faults.append(f"exit status {status}: {verdict.message[:300]!r}")


def _complaints(verdict: Verdict) -> Iterator[str]:
    if verdict.outcome == "refused" and "accepted: " not in verdict.message and "rank(S_b V_x)" not in verdict.message:
        yield f"does not say what is accepted: {verdict.message[:200]!r}"
    if len(verdict.message.splitlines()) > 1 or not is_plain(verdict.message):
        yield f"not one line of text: {verdict.message[:200]!r}"
    if len(verdict.message) > LONGEST_LINE:
        yield f"a line of {len(verdict.message)} characters"
    if verdict.growth > GROWTH_BYTES:
        yield f"took {verdict.growth / 2**20:.0f} MiB"


def _listing(folder: Path, allowed: list[str]) -> set[tuple[str, int, int]]:
    """All files, with size and time of change."""
    listed = set()
    for above, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if os.path.join(above, name) not in allowed]
        for name in (*folders, *files):
            path = os.path.join(above, name)
            state = os.lstat(path)
            if path not in allowed:
                listed.add((path, state.st_size if name in files else 0, state.st_mtime_ns if name in files else 0))
    return listed


@contextmanager
def _elsewhere(folder: Path) -> Iterator[None]:
    """Work in the folder, and make temporary files in it too, so that both are seen."""
    before = os.getcwd()
    temporary = tempfile.tempdir
    os.chdir(folder)
    tempfile.tempdir = str(folder)
    try:
        yield
    finally:
        os.chdir(before)
        tempfile.tempdir = temporary


@contextmanager
def _limits() -> Iterator[None]:
    """Stop what takes too long, and fail what wants too much memory."""

    def too_slow(*_: object) -> None:
        raise TooSlowError

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    timers = {signal.ITIMER_PROF: (signal.SIGPROF, WORK_SECONDS), signal.ITIMER_REAL: (signal.SIGALRM, WAITING_SECONDS)}
    before = {number: signal.signal(number, too_slow) for number, _ in timers.values()}
    for timer, (_, seconds) in timers.items():
        signal.setitimer(timer, seconds)
    if _STATUS.exists():
        resource.setrlimit(resource.RLIMIT_AS, (_status_bytes("VmSize:") + _ADDRESS_SPACE_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        for timer, (number, _) in timers.items():
            signal.setitimer(timer, 0.0)
            signal.signal(number, before[number])


def _clear_peak() -> int:
    """Bytes in memory now; the peak is counted from here on."""
    if not _CLEAR_PEAK.exists():
        return _peak()
    _CLEAR_PEAK.write_text("5")
    return _status_bytes("VmRSS:")


def _peak() -> int:
    if not _STATUS.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return _status_bytes("VmHWM:")


def _status_bytes(label: str) -> int:
    lines = _STATUS.read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(label))
