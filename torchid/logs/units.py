"""Units of foreign columns, what each is in SI units, and which ones numbers seem to be in by their ratio."""

from __future__ import annotations

import math
import re

from torchid.errors import ConfigError, excerpt
from torchid.parameters import WRENCH_COMPONENTS

_DEG = math.pi / 180.0
_TURN = 2.0 * math.pi
_GRAVITY = 9.80665
_POUND = 4.4482216152605

#: What a unit is in SI units, by the quantity that it is one of. Spaces, dots and powers are written in many ways: see
#: `_plain`. A kg of force is what a load cell shows under that mass; one of torque is a kg of force with a lever.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": _DEG, "rev": _TURN},
    "angular velocity": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEG, "rpm": _TURN / 60.0, "rev/s": _TURN},
    "angular acceleration": {"rad/s2": 1.0, "deg/s2": _DEG, "rpm/s": _TURN / 60.0, "rev/s2": _TURN},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "acceleration": {"m/s2": 1.0, "cm/s2": 1e-2, "mm/s2": 1e-3, "g": _GRAVITY, "mg": 1e-3 * _GRAVITY},
    "torque": {
        "Nm": 1.0, "Ncm": 1e-2, "Nmm": 1e-3, "mNm": 1e-3, "kNm": 1e3,
        "kgm": _GRAVITY, "kgcm": 1e-2 * _GRAVITY, "kgmm": 1e-3 * _GRAVITY, "gcm": 1e-5 * _GRAVITY,
    },
    "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "kg": _GRAVITY, "g": 1e-3 * _GRAVITY, "lbf": _POUND},
    "current": {"A": 1.0, "mA": 1e-3},
}  # fmt: skip

_ANGULAR = {"angular_velocity": "angular velocity", "angular_acceleration": "angular acceleration"}
_LINEAR = {
    "specific_force": "acceleration", "linear_acceleration": "acceleration", "linear_velocity": "velocity",
    "position": "length",
}  # fmt: skip
#: What numbers of a hinge and of a slide are.
OF_JOINTS = {
    "joint_position": ("angle", "length"),
    "joint_velocity": ("angular velocity", "velocity"),
    "joint_acceleration": ("angular acceleration", "acceleration"),
    "joint_torque": ("torque", "force"),
}
_SPELLINGS = {
    "°": "deg", "µ": "u", "μ": "u", "²": "2", "⁻": "-", "kgf": "kg", "radians": "rad", "milliseconds": "ms",
    "microseconds": "us", "nanoseconds": "ns", "seconds": "s", "sec": "s", "dps": "deg/s",
}  # fmt: skip
_DEGREES = re.compile(r"(?<![A-Za-z])[Dd]egrees?(?![A-Za-z])")
_PER_MINUTE = re.compile(r"(r|1) ?/ ?min", re.IGNORECASE)
_MARKS = re.compile(r"[ ·.*^]")
_POWERS = {"s-1": "/s", "s-2": "/s2", "/s/s": "/s2", "N-m": "Nm", "nm": "Nm"}
_BRACKETS = re.compile(r"(.*?)\s*(?:\[([^\[\]{}]*)\]|\(([^(){}]*)\))\s*")
_INSIDE = re.compile(r"\d+|[wxyzWXYZ]|[fm][xyz]|'.*'")  # of brackets: a number, component or field of records, no unit


#: Units of numbers about an axis in a file whose angles are in degrees.
IN_DEGREES = {"angle": "deg", "angular velocity": "deg/s", "angular acceleration": "deg/s2"}
#: Columns of translations in OpenSim's tables, such as pelvis_tx and /jointset/ground_pelvis/pelvis_tx/value.
TRANSLATION = re.compile(r"_t[xyz](?![A-Za-z0-9])")


def quantities_of(field: str, component: str = "") -> tuple[str, ...]:
    """The quantities that a field of a log, or one of its components, may have; none for numbers without a unit.

    A joint's are those of a hinge and of a slide.
    """
    if field == "time":
        return ("time",)
    if field in OF_JOINTS:
        return OF_JOINTS[field]
    if field == "contact_wrench_point_world":
        return ("length",)
    if field == "contact_force_normal":
        return ("force",)
    if component in WRENCH_COMPONENTS:
        return ("force",) if component.startswith("f") else ("torque",)
    return tuple(quantity for part, quantity in (_ANGULAR | _LINEAR).items() if part in field)


def unit_factor(key: str, unit: str, quantities: tuple[str, ...]) -> float:
    """What a number in a unit is multiplied by.

    Args:
        key: of the settings file, for messages.
        unit: such as `deg`, `N mm` or `m/s^2`.
        quantities: that it may be a unit of, from `quantities_of`.

    Raises:
        ConfigError: it is a unit of none of them.
    """
    plain = _plain(unit)
    for quantity in quantities:
        if plain in UNITS[quantity]:
            return UNITS[quantity][plain]
    others = [quantity for quantity, units in UNITS.items() if plain in units]
    reason = f"'{excerpt(unit)}', " + (f"a unit of {others[0]}" if others else "an unknown unit")
    accepted = ", ".join(text for quantity in quantities for text in UNITS[quantity])
    raise ConfigError.at_field(key, reason, accepted or "no unit: this number has none")


def quantities_with(unit: str) -> tuple[str, ...]:
    """The quantities that have a unit, none for a word that is no unit."""
    plain = _plain(unit)
    return tuple(quantity for quantity, units in UNITS.items() if plain in units)


def split_unit(column: str) -> tuple[str, str]:
    """The name of a column and the unit behind it, "" without one: `q1 [deg]`, `tau_hip (Nm)`, `Fz_N`, `vel_deg_s`.

    What brackets hold is a unit, known or not, unless it is a number or an axis; a suffix is one that is known.
    """
    match = _BRACKETS.fullmatch(column)
    if match:
        inside = (match[2] or match[3] or "").strip()
        return (column, "") if _INSIDE.fullmatch(inside) else (match[1], inside)
    for start in (match.start() for match in re.finditer(r"[_ .](?=[^_ .])", column)):
        text = column[start + 1 :].replace("_per_", "/")
        for unit in (text.replace("_", "/"), text.replace("_", "")):
            of_gyro = unit.strip() == "g" and column[:start].lower().endswith("imu")
            if quantities_with(unit) and unit != "A" and not of_gyro:  # which are letters as well
                return column[:start].rstrip("_ ."), unit
    return column, ""


def _plain(unit: str) -> str:
    """The unit as the table spells it: without spaces, dots, powers, capitals of long ones, and words in full."""
    unit = "g" if unit == "G" else unit
    unit = _PER_MINUTE.sub("rpm", _DEGREES.sub("deg", unit))
    for spelling, plain in _SPELLINGS.items():
        unit = unit.replace(spelling, plain)
    unit = _MARKS.sub("", unit)
    for spelling, plain in _POWERS.items():
        unit = unit.replace(spelling, plain)
    lower = unit.lower()
    return lower if lower.startswith(("deg", "rad", "rpm")) else unit


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
    return {name: units for name, units in found.items() if units}


def describe_units(found: dict[str, tuple[str, ...]]) -> str:
    """Text: 'joint_velocity is in deg/s, or time is in ms'."""
    return ", or ".join(f"{name} is in {' or '.join(units)}" for name, units in found.items())


def advise_units(found: dict[str, tuple[str, ...]]) -> str:
    """Advice: 'set logs.columns.time.unit: ms'."""
    return "set " + " or ".join(f"logs.columns.{name}.unit: {' or '.join(units)}" for name, units in found.items())


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
