"""What every answer to a hostile file must be: soon, in one line, in bounded memory, with nothing written and nothing run."""

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
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchid.errors import BaseLostError, InputError, TorchidWarning, is_plain
from torchid.reader import LIMITS

os.environ.setdefault(LIMITS, "0.6")  # of which cases are that know no end
SECONDS, WAITING = 5.0, 30.0  # of work, which other processes do not prolong; and until a case that waits is given up
BYTES = 2**30
LONGEST_LINE = 3000
_ADDRESS_SPACE = 6 * 2**30  # what a case may reserve beyond what there is: keeps the machine alive if a bomb goes off
_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate", "os.chmod")
_RUNS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pickle.find_class")
_CALLS = ("socket.connect", "socket.getaddrinfo", "urllib.Request", "ftplib.connect", "http.client.connect")
_OURS = "|".join(kind.__name__ for kind in (TorchidWarning, *TorchidWarning.__subclasses__()))
_HARMLESS = (TorchidWarning, DeprecationWarning, PendingDeprecationWarning)


class TooSlowError(BaseException):
    """Nothing may catch it."""


@dataclass
class Verdict:
    """What became of one case: "refused" (as bad input), "failed" (exit status 1) or "accepted", and what is wrong."""

    name: str
    outcome: str = "accepted"
    message: str = ""
    seconds: float = 0.0  # of work
    growth: int = 0
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

    def share(self, outcome: str) -> float:
        """Of the cases that ended so."""
        return sum(x.outcome == outcome for x in self.verdicts) / len(self.verdicts)

    def __str__(self) -> str:
        outcomes = Counter(x.outcome for x in self.verdicts)
        slow = max(self.verdicts, key=lambda x: x.seconds)
        big = max(self.verdicts, key=lambda x: x.growth)
        counted = ", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items()))
        return (
            f"{self.kind}: {len(self.verdicts)} cases: {counted}; slowest {slow.seconds:.2f} s ({slow.name}), "
            f"most memory {big.growth / 2**20:.0f} MiB ({big.name})"
        )


class _Watch:
    """What the interpreter does to the world while it is on."""

    def __init__(self) -> None:
        self.on, self.events, self.allowed = False, list[str](), list[str]()
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
        elif event in _CHANGES and not self._may(*_with_folder(event, arguments)):
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


def _with_folder(event: str, arguments: tuple[object, ...]) -> tuple[object, object]:
    """What an event changes, and the descriptor of the folder that it lies in."""
    place = {"os.mkdir": 2, "os.remove": 1, "os.rmdir": 1, "os.chmod": 2, "os.rename": 2, "os.link": 2, "os.symlink": 2}
    return arguments[0], arguments[place[event]] if event in place else -1


_watch = _Watch()


def judged(name: str, call: Callable[[], object], folder: Path, may_write: Iterable[Path] = ()) -> Verdict:
    """Run one case, which may change nothing in a folder but what stands under `may_write`.

    Args:
        name: of the case.
        call: reads the file, or runs a command and returns its exit status.
        folder: what is compared before and after; working and temporary folders lie in it.
        may_write: files and folders that a command may write.
    """
    verdict, allowed = Verdict(name), [str(path) for path in may_write]
    before, printed = _listing(folder, allowed), io.StringIO()
    _watch.events.clear()
    _watch.allowed = allowed
    rested, start = _resting(), time.process_time()
    try:
        with (
            _limits(),
            _elsewhere(folder),
            warnings.catch_warnings(record=True) as caught,
            redirect_stdout(io.StringIO()),
        ):
            warnings.simplefilter("always")
            with redirect_stderr(printed):
                _watch.on = True
                _settle(verdict, call(), printed)
    except (InputError, BaseLostError) as error:
        verdict.outcome, verdict.message = "refused", str(error)
    except TooSlowError:
        verdict.faults.append(f"not done after {SECONDS:g} s")
    except Exception as error:  # noqa: BLE001 - this is what is looked for
        verdict.faults.append(f"raised {type(error).__name__}: {str(error)[:300]}")
    finally:
        _watch.on = False
        verdict.seconds = time.process_time() - start
        verdict.growth = max(0, _peak() - rested)
    verdict.faults += dict.fromkeys(_watch.events)
    verdict.faults += [f"warned {w.category.__name__}: {w.message}" for w in caught if _is_foreign(w)]
    verdict.faults += [f"warned {w.message!r}" for w in caught if not is_plain(str(w.message))]
    verdict.faults += [f"left {path}" for path in sorted(_listing(folder, allowed) ^ before)]
    verdict.faults += _complaints(verdict)
    return verdict


def examined(
    kind: str,
    cases: Iterable[tuple[str, Any]],
    call: Callable[[Any], object],
    folder: Path,
    may_write: Iterable[Path] = (),
) -> Tally:
    """What became of every case of a kind, given to a call; printed too."""
    tally, allowed = Tally(kind), tuple(may_write)
    for name, case in cases:
        tally.verdicts.append(judged(name, lambda case=case: call(case), folder, allowed))
    print(tally)
    return tally


def _settle(verdict: Verdict, status: object, printed: io.StringIO) -> None:
    """Take a command's exit status and what it said on standard error, warnings aside."""
    lines = [line for line in printed.getvalue().splitlines() if not re.match(rf"torchid: ({_OURS}): ", line)]
    if not isinstance(status, int) or isinstance(status, bool):
        return
    verdict.outcome = {0: "accepted", 1: "failed", 2: "refused"}[status]
    verdict.message = "\n".join(lines)
    if not status and lines:
        verdict.faults.append(f"said {verdict.message[:200]!r}")
    if status == 1:
        verdict.faults.append(f"exit status 1: {verdict.message[:300]}")
    if status and not verdict.message.startswith("torchid: "):
        verdict.faults.append(f"said {verdict.message[:200]!r}")


def _complaints(verdict: Verdict) -> Iterator[str]:
    if verdict.outcome == "refused" and "accepted: " not in verdict.message and "rank(S_b V_x)" not in verdict.message:
        yield f"does not say what is accepted: {verdict.message[:200]!r}"
    if len(verdict.message.splitlines()) > 1 or not is_plain(verdict.message):
        yield f"not one line of text: {verdict.message[:200]!r}"
    if len(verdict.message) > LONGEST_LINE:
        yield f"a line of {len(verdict.message)} characters"
    if verdict.growth > BYTES:
        yield f"took {verdict.growth / 2**20:.0f} MiB"
    if verdict.seconds > SECONDS:
        yield f"took {verdict.seconds:.1f} s"


def _is_foreign(warning: warnings.WarningMessage) -> bool:
    return not issubclass(warning.category, _HARMLESS)


def _listing(folder: Path, allowed: list[str]) -> set[tuple[str, int, int]]:
    """All files, with size and time of change."""
    found = set()
    for above, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if os.path.join(above, name) not in allowed]
        for name in (*folders, *files):
            path = os.path.join(above, name)
            state = os.lstat(path)
            if path not in allowed:
                found.add((path, state.st_size if name in files else 0, state.st_mtime_ns if name in files else 0))
    return found


@contextmanager
def _elsewhere(folder: Path) -> Iterator[None]:
    """Work in the folder, and make temporary files in it too, so that both are seen."""
    before, temporary = os.getcwd(), tempfile.tempdir
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

    def limited(bytes_: int) -> None:
        resource.setrlimit(resource.RLIMIT_AS, (bytes_, hard))

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    timers = {signal.ITIMER_PROF: (signal.SIGPROF, SECONDS), signal.ITIMER_REAL: (signal.SIGALRM, WAITING)}
    before = {number: signal.signal(number, too_slow) for number, _ in timers.values()}
    for timer, (_, seconds) in timers.items():
        signal.setitimer(timer, seconds)
    limited(_kilobytes("VmSize:") * 1024 + _ADDRESS_SPACE if _STATUS.exists() else soft)
    try:
        yield
    finally:
        limited(soft)
        for timer, (number, _) in timers.items():
            signal.setitimer(timer, 0.0)
            signal.signal(number, before[number])


def _resting() -> int:
    """Bytes in memory now; the peak is counted from here on."""
    if not _CLEAR.exists():
        return _peak()
    _CLEAR.write_text("5")
    return _kilobytes("VmRSS:") * 1024


def _peak() -> int:
    if not _STATUS.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return _kilobytes("VmHWM:") * 1024


def _kilobytes(label: str) -> int:
    return next(int(line.split()[1]) for line in _STATUS.read_text().splitlines() if line.startswith(label))
