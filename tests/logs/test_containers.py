"""What the readers of other packages say of a damaged file becomes one line that a terminal can show."""

from __future__ import annotations

import pytest

from torchid.errors import LogError, about_file
from torchid.logs.containers import reader_errors_explained


def line_of(text: str) -> str:
    """The message made of a reader's own."""
    with pytest.raises(LogError) as caught, about_file("walk.h5"), reader_errors_explained("time", "an array"):
        raise OSError(text)
    return str(caught.value)


def test_a_readers_message_of_several_lines_becomes_one() -> None:
    expected = "walk.h5: time: cannot be read (OSError: no superblock at 0 x); accepted: an array"
    assert line_of("no superblock\n  at 0\r\n\tx\n") == expected


def test_bytes_of_the_file_in_a_readers_message_do_not_reach_the_terminal() -> None:
    assert "(OSError: bad name \\x1b[2Jevil\\u202e)" in line_of("bad name \x1b[2Jevil\u202e")


def test_a_reader_that_quotes_the_file_is_cut_short_and_its_end_stays() -> None:
    found = line_of("could not convert " + "x" * 10**6 + " in line 7")
    assert "OSError: could not convert xxx" in found
    assert "xxx in line 7 (1000028 characters)" in found
    assert len(found) < 300
