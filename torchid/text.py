"""Text in messages: lists and counts, and what of a text that someone else wrote may stand in one."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from typing import Any

#: Control characters, line breaks, halves of characters, and what is not seen but changes what is: directions, joints.
_UNPLAIN = ("Cc", "Cf", "Cs", "Zl", "Zp")


def is_plain(text: str) -> bool:
    """Whether a text has neither control characters, seen or not, nor line breaks."""
    return text.isprintable() or not any(unicodedata.category(letter) in _UNPLAIN for letter in text)


def excerpt(text: str, longest: int = 100) -> str:
    """The text as a message may repeat it: control characters as escapes, the middle of a long one left out."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-longest // 4 :]} ({len(text)} characters)"
    return escape(text)


def escape(text: str, kept: str = "") -> str:
    """The text with what is not plain as escapes, but for some characters that are kept."""
    if is_plain(text):
        return text
    return "".join(letter if letter in kept or is_plain(letter) else ascii(letter)[1:-1] for letter in text)


def one_line(text: str) -> str:
    """The text on one line, of plain characters."""
    return escape(" ".join(text.split()))


class EscapedStream:
    """A stream for people, to which nothing is written that moves the cursor or hides: only lines of plain text."""

    def __init__(self, stream: Any) -> None:
        """Write to a stream, which `raw_stream` gives back to who takes care of itself."""
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


def count_of(count: int, what: str) -> str:
    """A number of things, as in "1 gap" and "3 gaps"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
