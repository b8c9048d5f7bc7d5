"""What stands before the rows of a table of text: names of columns, separators, and OpenSim's lines before these."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from torchid.errors import LogError, excerpt
from torchid.logs.containers import OPENSIM

BLOCK = 2**22
"""Bytes of a table of text that are parsed at a time; no row may be longer."""

_SEPARATORS = (",", ";", "\t")
#: A cell such as -1,5 or 1,5e-3 between semicolons or tabs.
_DECIMAL_COMMA = re.compile(rb'(?:^|[;\t\n])[ "]*[+-]?\d*,\d+(?:[eE][+-]?\d+)?[ "]*(?=[;\t\r\n]|\Z)')
_END = "endheader"
_MOST_LINES = 1000  # before OpenSim's names of columns
_DEGREES = re.compile(r"\s*inDegrees\s*=\s*(\S*)\s*", re.IGNORECASE)


@dataclass(frozen=True)
class Header:
    """What a table of text has before its rows.

    Attributes:
        texts: names of its columns.
        separator: of cells.
        decimal_mark: of numbers.
        is_all: whether there are no rows.
        lines: up to the names of the columns, with these.
        unnamed: whether each row ends with one more, empty cell.
        in_degrees: whether angles are in degrees.
    """

    texts: list[str]
    separator: str
    decimal_mark: str
    is_all: bool
    lines: int = 1
    unnamed: bool = False
    in_degrees: bool = False

    @property
    def columns(self) -> list[str]:
        """Names of all columns, of an empty one at the end too."""
        return [*self.texts, *[""] * self.unnamed]


def read_header(path: Path) -> Header:
    """The header of a .csv, .mot or .sto file; the decimal mark is that of the rows after it.

    Raises:
        LogError: there are no names of columns.
    """
    with path.open("rb") as stream:
        lines, in_degrees = (1, False) if path.suffix.lower() not in OPENSIM else _skip_to_names(path, stream)
        line = stream.readline(BLOCK)
        rows = stream.read(BLOCK)
    if not line.strip():
        raise LogError(path, "header", "an empty line", "the names of the columns")
    if len(line) == BLOCK:
        raise LogError(path, "header", f"a line of at least {BLOCK} bytes", "the names of the columns")
    text = line.decode("utf-8-sig").rstrip("\r\n")
    if path.suffix.lower() in OPENSIM:
        return _opensim(path, text, rows, lines, in_degrees)
    names, failures = dict[str, list[str]](), list[csv.Error]()
    for mark in _SEPARATORS:
        try:
            names[mark] = next(csv.reader([text], strict=True, delimiter=mark))
        except csv.Error as error:  # behind a quoted name stands another mark
            failures.append(error)
    separator = max(names, key=lambda mark: len(names[mark]), default="")  # the first of equals
    if not separator or (failures and len(names[separator]) == 1):
        accepted = "names separated by commas, semicolons or tabs"
        raise LogError(path, "header", f"no line of names ({failures[0]})", accepted) from failures[0]
    texts = [text.strip() for text in names[separator]]
    decimal_comma = separator != "," and _DECIMAL_COMMA.search(rows) is not None
    return Header(texts, separator, "," if decimal_comma else ".", not rows.strip())


def _skip_to_names(path: Path, stream: BinaryIO) -> tuple[int, bool]:
    """Read up to the names of the columns: how many lines there are with these, and whether angles are in degrees."""
    in_degrees = False
    for number in range(1, _MOST_LINES):
        line = stream.readline(BLOCK)
        text = line.decode("utf-8-sig").strip()
        if found := _DEGREES.fullmatch(text):
            if found[1].lower() not in ("yes", "no"):
                raise LogError(path, "inDegrees", f"'{excerpt(found[1])}'", "yes or no")
            in_degrees = found[1].lower() == "yes"
        if text.lower() == _END:
            return number + 1, in_degrees
        if not line:
            break
    raise LogError(path, "header", f"no line {_END}", f"OpenSim's lines up to {_END}, then the names of the columns")


def _opensim(path: Path, text: str, rows: bytes, lines: int, in_degrees: bool) -> Header:
    """The header of an OpenSim table, whose cells tabs separate; its rows may end with another one."""
    texts = [name.strip() for name in text.rstrip().split("\t")]
    if len(texts) == 1 and len(text.split()) > 1:
        raise LogError(path, "header", f"names between spaces: {excerpt(text)}", "names separated by tabs")
    first = rows.lstrip(b"\r\n").partition(b"\n")[0].rstrip(b"\r").split(b"\t")
    unnamed = len(first) == len(texts) + 1 and not first[-1].strip()
    return Header(texts, "\t", ".", not rows.strip(), lines, unnamed, in_degrees)
