"""Errors and warnings of torchid, each its own one-line message, and what of foreign text may stand in one."""

from __future__ import annotations

import difflib
import inspect
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

E = TypeVar("E", bound="InputError")
#: Unicode categories of control characters, line breaks, surrogates and invisible formatting characters.
_UNPLAIN = ("Cc", "Cf", "Cs", "Zl", "Zp")


class TorchidError(Exception):
    """Base of every error that torchid raises on purpose."""


class InputError(TorchidError, ValueError):
    """Something a user supplied cannot be used.

    The message is one line: where it was found (a file or an argument; nothing if `source` is empty), which field, what
    was found and what is accepted.
    """

    def __init__(self, source: object, field: str, reason: str, accepted: str) -> None:
        self.source = str(source)
        self.field = field
        self.found = reason
        self.accepted = accepted
        super().__init__(one_line(_prefixed(source, f"{field}: {reason}; accepted: {accepted}")))

    @classmethod
    def at_field(cls: type[E], field: str, *rest: Any) -> E:
        """The error at a field of `current_file`; `rest`: what follows the field in the arguments of the class."""
        return cls(current_file(), field, *rest)

    def __reduce__(self) -> tuple[object, ...]:
        """Errors of worker processes, which may be about another file than their parent, reach it as they are."""
        return type(self), (self.source, self.field, self.found, self.accepted)


class UrdfError(InputError):
    """A URDF that does not describe a tree of rigid bodies torchid can use."""


class LogError(InputError):
    """A log that is malformed, inconsistent, or lacks what the run needs."""


class ConfigError(InputError):
    """An experiment file or an override with an unknown key or an unusable value."""


class SensorError(InputError):
    """A sensor set or contact that does not fit the robot."""


class ImplausibleFitError(InputError):
    """A fit that is impossible for any robot: the data, not the robot, are wrong."""


class UnknownNameError(InputError, KeyError):
    """An unknown name; the message lists the nearest valid names."""

    def __init__(self, source: object, field: str, name: str, valid: Iterable[str], what: str = "") -> None:
        """Take the name and the valid ones; `what` describes a name that is known, but not valid here."""
        self.name = name
        self.valid = tuple(valid)
        self.what = what
        reason = f"'{name}', {what}" if what else f"unknown name '{excerpt(name)}'"
        super().__init__(source, field, reason, _nearest_names(name, self.valid))

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.source, self.field, self.name, self.valid, self.what)

    __str__ = Exception.__str__  # KeyError would show the repr of the message


class BaseLostError(TorchidError):
    """The base is lost in the projection: rank(S_b V_x) < 6 in some contact state."""


class TorchidWarning(UserWarning):
    """Base of every warning that torchid gives on purpose."""


class MasslessBodyWarning(TorchidWarning):
    """A body that no child follows has no inertia; its inertial parameters stay out of the fit."""


class UnphysicalInertiaWarning(TorchidWarning):
    """A link's or body's inertia belongs to no distribution of positive mass."""


class BaseLostWarning(TorchidWarning):
    """As BaseLostError, where the fit goes on (`sensors.on_base_lost: warn`)."""


class ConfoundedWarning(TorchidWarning):
    """Parameters that are confounded with a sensor's offset or scale."""


class NumericalWarning(TorchidWarning):
    """A result whose accuracy is limited by the conditioning of the problem."""


def warn(message: str, category: type[TorchidWarning] = TorchidWarning) -> None:
    """Warn, as of the line outside of torchid that led here: that is the line that a user can change."""
    frame = inspect.currentframe()
    level = 1
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == __package__:
        frame = frame.f_back
        level = level + 1
    warnings.warn(message, category, stacklevel=level)


def warn_about_file(message: str, category: type[TorchidWarning] = TorchidWarning) -> None:
    """As `warn`, the message with `current_file` before it, if there is one."""
    warn(_prefixed(current_file(), message), category)


def how_to_install(extra: str) -> str:
    """How to install the packages of an extra; the name torchid on PyPI is not ours."""
    return f"pip install '.[{extra}]' in the clone of torchid"


_file: ContextVar[str] = ContextVar("_file", default="")


@contextmanager
def about_file(file: object) -> Iterator[None]:
    """Let errors and warnings within the block that name a field alone be about a field of this file."""
    token = _file.set(str(file))
    try:
        yield
    finally:
        _file.reset(token)


def current_file() -> str:
    """The file that the innermost `about_file` names; empty outside of all."""
    return _file.get()


@contextmanager
def during(doing: str, source: object) -> Iterator[None]:
    """As `about_file`; and let an error that leaves the block say what was being done to it: the innermost says it.

    Args:
        doing: such as "reading".
        source: the file or folder.
    """
    try:
        with about_file(source):
            yield
    except Exception as error:
        if not activity_of(error):
            error._torchid_doing = f"{doing} {source}"  # type: ignore[attr-defined]
        raise


def activity_of(error: BaseException) -> str:
    """What was being done when an error came up, as `during` noted; empty if it did not."""
    return str(getattr(error, "_torchid_doing", ""))


def _prefixed(source: object, text: str) -> str:
    return f"{source}: {text}" if str(source) else text


def _nearest_names(name: str, valid: Iterable[str]) -> str:
    """The names in `valid` closest to `name`, or the first few of them, as one readable string."""
    valid = list(valid)
    close = difflib.get_close_matches(name, valid, n=3, cutoff=0.5)
    if close:
        return ", ".join(close)
    shown = ", ".join(valid[:8])
    return (f"{shown}, ... ({len(valid)} names)" if len(valid) > 8 else shown) or "none"


# ------------------------------------------------------------------------------------------------- text in messages


def is_plain(text: str) -> bool:
    """Whether a text has neither control characters, visible or not, nor line breaks."""
    return text.isprintable() or not any(unicodedata.category(letter) in _UNPLAIN for letter in text)


def excerpt(text: str, longest: int = 100) -> str:
    """The text for use in a message: control characters escaped, the middle of a long text left out."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-longest // 4 :]} ({len(text)} characters)"
    return escape(text)


def escape(text: str, kept: str = "") -> str:
    """The text with control characters as escapes, except for the characters in `kept`."""
    if is_plain(text):
        return text
    return "".join(letter if letter in kept or is_plain(letter) else ascii(letter)[1:-1] for letter in text)


def one_line(text: str) -> str:
    """The text on one line, of plain characters."""
    return escape(" ".join(text.split()))


class EscapedStream:
    """A stream to a terminal that escapes control characters, which could move the cursor or hide text."""

    def __init__(self, stream: Any) -> None:
        """Write to a stream, which `raw_stream` returns to code that escapes by itself."""
        self.plain_stream = stream

    def write(self, text: str) -> int:
        """Write a text; its length."""
        self.plain_stream.write(escape(text, "\n\t"))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write texts."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.plain_stream, name)


def raw_stream(stream: Any) -> Any:
    """The stream below an `EscapedStream`."""
    return getattr(stream, "plain_stream", stream)


def join_names(names: Sequence[str], most: int = 4) -> str:
    """Names joined by commas, the first few of many."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def format_count(count: int, what: str) -> str:
    """A number with its noun, as in "1 gap" and "3 gaps"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def format_percent(share: float, sign: str = "") -> str:
    """A share in percent, to two digits or whole, as in "8.3", "83" and "830"; `sign`: "+" for that of gains, too."""
    percent = 100.0 * share
    return f"{percent:{sign}.2g}" if abs(percent) < 99.5 else f"{percent:{sign}.0f}"
