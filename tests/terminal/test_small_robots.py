"""What is printed of robots whose masses are grams."""

from __future__ import annotations

import pytest

from torchid.estimators.least_squares import IDENTIFIED, PRIOR
from torchid.reprs import decimal
from torchid.terminal.identification import _cell


@pytest.mark.parametrize(
    ("value", "text"), [(1.0e-7, "1e-07"), (0.00771, "0.00771"), (2.5, "2.500"), (0.0, "0.000"), (-0.004, "-0.004")]
)
def test_masses_have_three_significant_digits(value: float, text: str) -> None:
    assert decimal(value) == text


def test_an_error_of_less_than_five_decimals_is_printed() -> None:
    assert _cell(3.93e-13, 6.0e-13, IDENTIFIED).strip() == "3.9e-13 ± 6e-13"
    assert _cell(1.0e-19, 6.0e-13, IDENTIFIED).strip() == "0 ± 6e-13"
    assert _cell(0.1234, 0.02, IDENTIFIED).strip() == "0.123 ± 0.020"
    assert _cell(0.1234, 0.02, PRIOR).strip() == "0.123 p"
