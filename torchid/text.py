"""Text in messages: lists and counts, and what of a text that someone else wrote may stand in one."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence

_CONTROL = ("Cc", "Cs", "Zl", "Zp")  # they move the cursor, break the line, or are no character at all
_TURNING = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # the direction in which the rest is shown


def is_plain(text: str) -> bool:
    """Whether a text has neither control characters nor line breaks."""
    return text.isprintable() or not any(
        unicodedata.category(letter) in _CONTROL or letter in _TURNING for letter in text
    )


def shown(text: str, longest: int = 100) -> str:
    """The text as a message may repeat it: control characters as escapes, the middle of a long one left out."""
    if len(text) > longest:
        text = f"{text[: longest // 2]} ... {text[-longest // 4 :]} ({len(text)} characters)"
    return "".join(letter if is_plain(letter) else ascii(letter)[1:-1] for letter in text)


def listed(names: Sequence[str], most: int = 4) -> str:
    """Names joined by commas, the first few of many."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def counted(count: int, what: str) -> str:
    """A number of things, as in "1 gap" and "3 gaps"."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"
