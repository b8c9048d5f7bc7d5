"""Errors and warnings of torchid, each with a one-line message, and helpers for text in messages."""

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
    """Base class of all errors that torchid raises on purpose."""


class InputError(TorchidError, ValueError):
    """An input from the user cannot be used.

    The message is one line: the source (file or argument; nothing if `source` is empty), the field, what was found and
    what is accepted.
    """

    def __init__(self, source: object, field: str, reason: str, accepted: str) -> None:
        self.source = str(source)
        self.field = field
        self.found = reason
        self.accepted = accepted
        super().__init__(one_line(_prefixed(source, f"{field}: {reason}; accepted: {accepted}")))

    @classmethod
    def at_field(cls: type[E], field: str, *rest: Any) -> E:
        """The error at a field of `current_file`; `rest`: further arguments of the class."""
        return cls(current_file(), field, *rest)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle errors of worker processes unchanged."""
        return type(self), (self.source, self.field, self.found, self.accepted)


class UrdfError(InputError):
    """A URDF that is not a tree of rigid bodies that torchid can use."""


class LogError(InputError):
    """A log that is malformed, inconsistent, or lacks what the run needs."""


class ConfigError(InputError):
    """An experiment file or an override with an unknown key or a wrong value."""


class SensorError(InputError):
    """A sensor set or contact that does not fit the robot."""


class ImplausibleFitError(InputError):
    """A fit result that is impossible for any robot: the data are wrong."""


class UnknownNameError(InputError, KeyError):
    """An unknown name; the message lists the nearest valid names."""

    def __init__(self, source: object, field: str, name: str, valid: Iterable[str], what: str = "") -> None:
        """Take the name and the valid names; `what` explains why a known name is not valid here."""
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
    """Base class of all warnings of torchid."""


class MasslessBodyWarning(TorchidWarning):
    """A body at the end of a limb has no inertia; its inertial parameters are not fitted."""


class UnphysicalInertiaWarning(TorchidWarning):
    """The inertia of a link or body is not physically consistent."""


class BaseLostWarning(TorchidWarning):
    """As BaseLostError, but the fit continues (`sensors.on_base_lost: warn`)."""


class ConfoundedWarning(TorchidWarning):
    """Parameters are confounded with a sensor's offset or scale."""


class NumericalWarning(TorchidWarning):
    """The conditioning of the problem limits the accuracy of a result."""


def warn(message: str, category: type[TorchidWarning] = TorchidWarning) -> None:
    """Warn at the line outside of torchid that called it: the line that a user can change."""
    frame = inspect.currentframe()
    level = 1
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == __package__:
        frame = frame.f_back
        level = level + 1
    warnings.warn(message, category, stacklevel=level)


def warn_about_file(message: str, category: type[TorchidWarning] = TorchidWarning) -> None:
    """As `warn`, with `current_file` before the message."""
    warn(_prefixed(current_file(), message), category)


def how_to_install(extra: str) -> str:
    """Command that installs an extra; the name torchid on PyPI belongs to another project."""
    return f"pip install '.[{extra}]' in the clone of torchid"


_file: ContextVar[str] = ContextVar("_file", default="")


@contextmanager
def about_file(file: object) -> Iterator[None]:
    """Errors and warnings inside the block that name only a field are about this file."""
    token = _file.set(str(file))
    try:
        yield
    finally:
        _file.reset(token)


def current_file() -> str:
    """File of the innermost `about_file`; "" outside."""
    return _file.get()


@contextmanager
def during(doing: str, source: object) -> Iterator[None]:
    """As `about_file`; errors that leave the block also note the activity.

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
    """The activity that `during` noted for an error; "" without one."""
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
    """Short text for a message: control characters escaped, the middle of a long text removed."""
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
    """A terminal stream that escapes control characters, which could move the cursor or hide text."""

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
    """A number with its noun, such as "1 gap" and "3 gaps"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def format_percent(share: float, sign: str = "") -> str:
    """A fraction in percent with two digits, such as "8.3", "83" and "830"; `sign` "+" also shows the sign of gains."""
    percent = 100.0 * share
    return f"{percent:{sign}.2g}" if abs(percent) < 99.5 else f"{percent:{sign}.0f}"
