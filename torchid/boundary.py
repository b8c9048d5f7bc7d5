"""Run a command for its user: every failure is reported in one line of plain text."""

from __future__ import annotations

import errno
import gc
import logging
import os
import re
import shutil
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout, suppress
from textwrap import fill

from torchid import distributed
from torchid.errors import (
    BaseLostError,
    ConfoundedWarning,
    EscapedStream,
    InputError,
    TorchidError,
    TorchidWarning,
    activity_of,
    format_count,
    one_line,
)
from torchid.staging import interrupts_deferred, list_written, reset_written, termination_as_interrupt

#: Errors of the system, not of the user's files or the program: no room, no memory, no permission.
_MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.EMFILE)
#: Numerical warnings of libraries, which may affect results; other warnings are meant for programmers.
_NUMERICAL = (RuntimeWarning,)


def run_guarded(
    program: str, command: Callable[[], int | None], debug: bool = False, fold_warnings: bool = False
) -> int:
    """Run a command; every failure is reported in one line.

    Control characters in all output are escaped. Numerical warnings of libraries are printed as one line, as they may
    affect results; their other warnings and log messages are shown with `debug` only.

    Args:
        program: its name.
        command: what to run; returns an exit status, None for 0.
        debug: whether to show tracebacks and all warnings.
        fold_warnings: whether a terminal gets the first of alike warnings alone, of what is confounded none, as the
            answer says it, and at last how many there were; a file or pipe gets all.

    Returns:
        The exit status: the command's own or 0 on success, 2 on bad input, 1 on anything else, silently if the
        output pipe was closed.
    """
    with plain_streams(), warnings.catch_warnings(), _libraries_silent(debug):
        warnings.simplefilter("always", TorchidWarning)
        warnings.showwarning = shown = _Warnings(program, debug, fold_warnings and sys.stderr.isatty())
        try:
            reset_written()
            with termination_as_interrupt():
                status = command() or 0
            sys.stdout.flush()
            return status
        except BrokenPipeError:  # `torchid ... | head` is not an error
            _redirect_to_null(sys.stdout)
            return 1
        except KeyboardInterrupt as interrupt:
            _print_line(program, str(interrupt) or f"interrupted; {list_written()} was written")
            return 1
        except Exception as error:  # a full disk, or a bug: no traceback unless `debug`
            if debug:
                traceback.print_exc()
            status, line = _describe_failure(error)
            _print_line(program, line)
            return status
        finally:
            shown.count_folded()


def run_distributed(program: str, run: Callable[[], int]) -> int:
    """Run a command in this process, or in all that torchrun has started: the first prints, all end with one status.

    Args:
        program: its name.
        run: the whole command, from its arguments to its exit status.

    Returns:
        The exit status; a process that torchrun has started does not return.
    """
    try:
        if not distributed.join_launched():
            return run()
    except distributed.ConnectionFailedError as error:
        _print_line(program, str(error))
        return 1
    with nullcontext() if distributed.is_launched_first() else _silence():
        try:
            status = run()
        except SystemExit as leaving:  # of argparse
            status = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    return distributed.leave_launched(status)


@contextmanager
def _silence() -> Iterator[None]:
    """Drop standard output and error of Python."""
    with open(os.devnull, "w", encoding="utf-8") as null, redirect_stdout(null), redirect_stderr(null):
        yield


def _describe_failure(error: Exception) -> tuple[int, str]:
    """Exit status and the line that reports an error."""
    if isinstance(error, (InputError, BaseLostError)):
        return 2, str(error)
    if isinstance(error, TorchidError):  # of processes that share the work
        return 1, str(error)
    activity = activity_of(error)
    where = f"{activity}: " if activity else ""
    if isinstance(error, MemoryError):
        return 1, f"{where}not enough memory ({str(error) or 'the system gives no more'}); accepted: smaller logs"
    if isinstance(error, OSError) and error.errno in _MACHINE:
        return 1, f"{where}{type(error).__name__}: {error}"
    text = str(error) or "no text"
    report = "this is a bug in torchid: please report it with the output of --debug"
    return 1, f"{where}{type(error).__name__}: {text}; {report}"


class _Warnings:
    """Prints warnings as lines: of libraries once, and if `fold` alike ones once, and none that the answer repeats."""

    def __init__(self, program: str, debug: bool, fold: bool) -> None:
        self._program = program
        self._debug = debug
        self._fold = fold
        self._printed = set[str]()
        self._folded = 0

    def __call__(self, message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        text = kind = f"{category.__name__}: {message}"
        if issubclass(category, TorchidWarning):
            kind = _without_names(text)
            if self._fold and issubclass(category, ConfoundedWarning):
                return
            if self._fold and kind in self._printed:
                self._folded += 1
                return
        else:
            if not (self._debug or issubclass(category, _NUMERICAL)) or kind in self._printed:
                return
            text = f"NumericalWarning: a library could not handle a number ({message})"
        self._printed.add(kind)
        _print_line(self._program, text)

    def count_folded(self) -> None:
        """Print how many warnings have not been printed, if any."""
        if self._folded:
            _print_line(self._program, f"and {format_count(self._folded, 'warning')} like these; --verbose shows them")


def _without_names(text: str) -> str:
    """What is alike in warnings of many logs: without the name that comes first, quoted ones and numbers."""
    category, _, message = text.partition(": ")
    return category + re.sub(r"'[^']*'|\d[\d.]*(e[-+]?\d+)?", "#", message.partition(": ")[2] or message)


def _print_line(program: str, text: str) -> None:
    """Print one line; on a terminal broken between words, as answers are."""
    line = f"{program}: {one_line(text)}"
    if sys.stderr.isatty():  # `wrap_words` would import torch, for seconds
        width = min(shutil.get_terminal_size().columns, 100)
        line = fill(line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)
    with suppress(BrokenPipeError):
        print(line, file=sys.stderr)


def _redirect_to_null(stream: object) -> None:
    """Redirect a closed pipe, so that the interpreter's last flush does not fail."""
    with suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # type: ignore[attr-defined]


def open_closed_streams() -> None:
    """Let the null device take the place of standard output and error where this process was started without them."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w", encoding="utf-8"))


@contextmanager
def plain_streams() -> Iterator[None]:
    """Escape control characters in all text that is written to standard output and error."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (EscapedStream(stream) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


@contextmanager
def _libraries_silent(debug: bool) -> Iterator[None]:
    """Keep log messages and threads of libraries from standard error: they often contain text of files.

    What fails in the thread that writes event files is raised where they are written to.
    """
    handler = logging.NullHandler()
    root = logging.getLogger()
    hook = threading.excepthook
    if not debug:
        root.addHandler(handler)  # without a handler, Python writes warnings to standard error
        threading.excepthook = _ignore
    try:
        yield
    finally:
        root.removeHandler(handler)
        threading.excepthook = hook


def _ignore(_: threading.ExceptHookArgs) -> None:
    """What a thread failed of."""


@contextmanager
def importing() -> Iterator[None]:
    """Import what a command needs, uninterrupted; garbage is not looked for among a million objects that all stay."""
    collects = gc.isenabled()
    gc.disable()  # a seventh of the time of all imports
    try:
        with interrupts_deferred():
            yield
    finally:
        gc.freeze()  # later looks, and those when Python ends, are a sixth of the processor time of the demo
        if collects:
            gc.enable()
