"""`parameters.json`: nominal and identified parameters of every body."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from torchid.analysis.calibration import ExtraEstimate
from torchid.errors import InputError, during
from torchid.estimators import Estimate
from torchid.guards import MAX_JSON, read_bytes
from torchid.parameters import PARAMETERS, PER_BODY, UNITS, Array
from torchid.robot import Robot

_LARGEST = 1e100
_ACCEPTED = "a number between -1e100 and 1e100"


def parameters_document(
    robot: Robot, estimate: Estimate, by_state: Mapping[str, Estimate], extras: Sequence[ExtraEstimate] = ()
) -> dict[str, Any]:
    """What `parameters.json` holds; a standard error or a share that the data do not give is null.

    Args:
        robot: the robot.
        estimate: of all data.
        by_state: of the data of each contact state alone.
        extras: unknowns beside the bodies' parameters.
    """
    nominal = [{"nominal": _named(phi)} for phi in robot.nominal]
    found = _bodies(robot, {"identified": estimate.phi} | _judged(estimate))
    return {
        "units": dict(zip(PARAMETERS, UNITS, strict=True)),
        "frame": "each body's link frame, inertia about its origin",
        "massless": list(robot.massless),
        "verdicts": estimate.verdict_counts(),
        "bodies": [{"name": body["name"]} | before | body for body, before in zip(found, nominal, strict=True)],
        "extras": [_extra(x) for x in extras],
        "contact_states": [
            {
                "name": name,
                "rank": alone.rank,
                "condition_number": _plain(alone.condition_number),
                "singular_values": alone.singular_values.tolist(),
                "verdicts": alone.verdict_counts(),
                "bodies": _bodies(robot, _judged(alone)),
            }
            for name, alone in by_state.items()
        ],
    }


def _judged(estimate: Estimate) -> dict[str, np.ndarray]:
    """How far each parameter can be trusted, (12 L,) each."""
    names = ("standard_error", "identifiable", "data_share", "verdict")
    return {name: getattr(estimate, name) for name in names}


def _bodies(robot: Robot, columns: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Columns (12 L,) by body and parameter."""
    per_body = {name: x.reshape(-1, PER_BODY) for name, x in columns.items()}
    return [
        {"name": name} | {column: _named(values[body]) for column, values in per_body.items()}
        for body, name in enumerate(robot.body_names)
    ]


def _extra(found: ExtraEstimate) -> dict[str, Any]:
    """An unknown beside the bodies' parameters; `log` is null for one of all logs."""
    extra = found.extra
    return {
        "what": extra.what,
        "name": extra.name,
        "component": extra.component or None,
        "log": found.log or None,
        "unit": extra.unit,
        "value": found.value,
        "nominal_value": found.nominal_value,
        "standard_error": _plain(found.standard_error),
        "inflation": _plain(found.inflation),
        "told_apart": found.told_apart,
        "mixed_with": list(found.mixed_with),
        "label": extra.label,
    }


def read_shared_extras(path: Path, column: str = "value") -> dict[str, float]:
    """Values of the unknowns of all logs, by `Extra.label`, of a run's file.

    Args:
        path: `parameters.json`.
        column: "value" or "nominal_value".

    Raises:
        InputError: an entry that is none.
    """
    entries = _document(path).get("extras", [])
    out = {}
    for entry in entries if isinstance(entries, list) else [None]:
        if not (isinstance(entry, dict) and isinstance(entry.get("label"), str)):
            raise InputError(path, "extras", "an entry without a label", "what torchid identify wrote")
        value = entry.get(column)
        if not _is_usable(value):
            raise InputError(path, f"extras, {entry['label']}, {column}", f"{value!r}", _ACCEPTED)
        if entry.get("log") is None:
            out[entry["label"]] = float(value)
    return out


def _named(values: np.ndarray) -> dict[str, Any]:
    return {name: _plain(x) for name, x in zip(PARAMETERS, values, strict=True)}


def read_parameters(path: Path, robot: Robot) -> Array:
    """Identified parameters, (L, 12), of a `parameters.json` that belongs to the robot.

    Raises:
        InputError: the file cannot be read or holds other bodies.
    """
    bodies = _document(path).get("bodies")
    bodies = bodies if isinstance(bodies, list) else []
    names = [body.get("name") if isinstance(body, dict) else None for body in bodies]
    if names != list(robot.body_names):
        raise InputError(path, "bodies", f"not the bodies of {robot.path}", ", ".join(robot.body_names))
    return np.array([[_number(path, body, name) for name in PARAMETERS] for body in bodies])


def _document(path: Path) -> dict[str, Any]:
    try:
        with during("reading", path):
            document = json.loads(read_bytes(path, MAX_JSON).decode())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "file", f"not readable as JSON ({error})", "a run's parameters.json") from error
    return document if isinstance(document, dict) else {}


def _number(path: Path, body: dict[str, Any], name: str) -> float:
    identified = body.get("identified")
    value = identified.get(name) if isinstance(identified, dict) else None
    if not _is_usable(value):
        raise InputError(path, f"body '{body['name']}', identified.{name}", f"{value!r}", _ACCEPTED)
    return float(value)


def _is_usable(value: object) -> TypeGuard[float]:
    """Whether it is a number whose products and squares a float64 can hold."""
    return not isinstance(value, bool) and isinstance(value, (int, float)) and abs(value) <= _LARGEST


def _plain(x: Any) -> float | bool | str | None:
    if isinstance(x, str):
        return str(x)
    if isinstance(x, np.bool_):
        return bool(x)
    return float(x) if np.isfinite(x) else None
