"""Texts and tables within a number of columns."""

from __future__ import annotations

import pytest

from torchid.report.tables import CUT, WIDTH, column_lines, labelled, terminal_width, wrap_words

LONG = "front-left-limb-of-a-robot-whose-names-are-longer-than-a-line"


@pytest.mark.parametrize("width", [-4, 1, 10, 30, 80])
def test_words_are_never_broken_and_all_of_them_come(width: int) -> None:
    text = f"the base is lost where {LONG} and r_knee are at zero: {LONG}, l_knee"
    lines = wrap_words(text, width, "  ")
    assert " ".join(" ".join(lines).split()) == text
    assert all(len(line) <= width or line.strip() in text.split() for line in lines)


@pytest.mark.parametrize("width", range(12, 60, 3))
@pytest.mark.parametrize("most", [1, 2])
def test_what_has_no_room_is_cut_between_words_and_marked(width: int, most: int) -> None:
    text = "twelve sensors suffice at a cost of twelve and no cheaper set of sensors exists for this robot"
    lines = wrap_words(text, width, most=most)
    said = " ".join(lines)
    assert len(lines) <= most
    assert max(map(len, lines)) <= width
    assert said == text or (said.endswith(CUT) and f"{text} ".startswith(f"{said.removesuffix(CUT)} "))


@pytest.mark.parametrize(
    ("width", "most", "said"),
    [
        (60, 1, "one jump in hip, knee and ankle; ..."),
        (30, 1, "one jump in hip, ..."),
        (50, 2, "one jump in hip, knee and ankle; the clearest: hip by 0.26 rad from 1335 to 1336, ..."),
        (44, 2, "one jump in hip, knee and ankle; the clearest: hip by 0.26 rad from 1335 to ..."),
    ],
)
def test_what_has_no_room_is_cut_where_a_clause_begins_unless_half_would_be_lost(
    width: int, most: int, said: str
) -> None:
    text = "one jump in hip, knee and ankle; the clearest: hip by 0.26 rad from 1335 to 1336, 342 times the noise there"
    assert " ".join(wrap_words(text, width, most=most)) == said


def test_a_label_stands_before_the_first_line_alone() -> None:
    assert labelled("bodies", "all can exist", 25) == ["bodies        all can", "              exist"]


def test_columns_are_dropped_from_the_last_until_names_and_the_first_fit() -> None:
    columns = [("mass", ["1.0", "22.0"]), ("nothing", ["", " "]), ("friction", ["0.1", "0.2"])]
    table = column_lines(("body", ["trunk", "l\nfoot"]), columns, 40)
    assert table == ["body    mass  friction", "trunk    1.0       0.1", "l foot  22.0       0.2"]
    assert column_lines(("body", ["trunk", "foot"]), columns, 15) == ["body   mass", "trunk   1.0", "foot   22.0"]
    wide = column_lines(("body", [LONG, "foot"]), columns, 20)
    assert [line.split() for line in wide] == [["body", "mass"], [LONG, "1.0"], ["foot", "22.0"]]


@pytest.mark.parametrize(("stated", "width"), [("80", 80), ("300", WIDTH), ("", WIDTH), ("many", WIDTH), (None, WIDTH)])
def test_what_is_redirected_is_as_wide_as_columns_says(
    stated: str | None, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    if stated is not None:
        monkeypatch.setenv("COLUMNS", stated)
    assert terminal_width() == width
