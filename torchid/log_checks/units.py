"""Units that numbers seem to be in, by the factor between what was recorded and what it should be."""

from __future__ import annotations

from torchid.logs.units import UNITS, quantities_of

#: Deviation from the factor of a unit: a filter in a driver takes a tenth.
UNIT_TOLERANCE = 0.15


def units_of_ratio(ratio: float, quantities: tuple[str, ...], tolerance: float = UNIT_TOLERANCE) -> tuple[str, ...]:
    """Units, the nearest first, in which numbers are `ratio` times those in SI units; none for SI units.

    Args:
        ratio: of what was recorded to what it is in SI units.
        quantities: that the unit may be one of, keys of `UNITS`.
        tolerance: largest relative deviation of the ratio.
    """
    away = {
        unit: abs(ratio * factor - 1.0)
        for quantity in quantities
        for unit, factor in UNITS[quantity].items()
        if factor != 1.0
    }
    return tuple(sorted((unit for unit in away if away[unit] < tolerance), key=away.__getitem__))


def units_of_derivative_ratio(ratio: float, field: str, base: str, order: int | None) -> dict[str, tuple[str, ...]]:
    """Units of `field`, of its `base` or of time in which it would be `ratio` times the derivative; by field.

    Args:
        ratio: of the recorded to the true derivative.
        field: of a log.
        base: that it is a derivative of.
        order: of the derivative; None where time is no cause, as it is that of all channels.
    """
    if ratio <= 0.0:
        return {}
    found = {
        field: units_of_ratio(ratio, quantities_of(field)),
        base: units_of_ratio(1.0 / ratio, quantities_of(base)),
        "time": units_of_ratio(ratio ** (1.0 / order), ("time",)) if order else (),
    }
    return {of: units for of, units in found.items() if units}


def describe_units(found: dict[str, tuple[str, ...]]) -> str:
    """Text: 'joint_velocity is in deg/s, or time is in ms'."""
    return ", or ".join(f"{of} is in {' or '.join(units)}" for of, units in found.items())


def advise_units(found: dict[str, tuple[str, ...]]) -> str:
    """What to write in a map of columns: 'logs.columns.time.unit: ms'."""
    return " or ".join(f"logs.columns.{of}.unit: {' or '.join(units)}" for of, units in found.items())


def other_units(quantity: str) -> dict[str, float]:
    """Factors of other units than SI's to SI's; units that no data tell apart are one: 'Nmm or mNm'."""
    alike: list[tuple[list[str], float]] = []
    for unit, factor in UNITS[quantity].items():
        names = next((names for names, other in alike if abs(factor / other - 1.0) < UNIT_TOLERANCE), None)
        if names is not None:
            names.append(unit)
        else:
            alike.append(([unit], factor))
    return {" or ".join(names): factor for names, factor in alike if factor != 1.0}
