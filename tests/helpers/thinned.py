"""Parametrized tests of which a few cases always run, and all with `-m study` or `-m ""`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import product
from typing import Any

import pytest

STUDY = pytest.mark.study


def study_but(always: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases, one value each, all but some marked as studies."""
    return [case if case in always else pytest.param(case, marks=STUDY) for case in cases]


def each_once(*choices: Sequence[Any], rounds: int = 1) -> list[Any]:
    """All combinations of some choices, marked as studies but for some in which each choice comes up at least once.

    In the next round each comes up with its neighbour's company.
    """
    turns = range(max(map(len, choices)))
    always = {
        tuple((turn + number * more) % len(one) for number, one in enumerate(choices))
        for more in range(rounds)
        for turn in turns
    }
    return [
        pytest.param(
            *(one[place] for one, place in zip(choices, places, strict=True)),
            marks=() if places in always else STUDY,
        )
        for places in product(*(range(len(one)) for one in choices))
    ]
