"""What of a text that someone else wrote may stand in a message, a name or a path."""

from __future__ import annotations

import unicodedata

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
