"""Files of identified parameters, `parameters.json`, and of samples of their posterior."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import InputError, during
from torchid.estimators import Estimate
from torchid.fitting.posterior import FittedPosterior, ParameterSamples
from torchid.guards import MAX_JSON, read_bytes
from torchid.identifiability.confounding import ExtraEstimate
from torchid.parameters import PARAMETER_UNITS, PARAMETERS, PER_BODY, Array
from torchid.robot import Robot

_MAX_NUMBER = 1e100  # products and squares stay within the range of float64


def parameters_document(
    robot: Robot, estimate: Estimate, by_state: Mapping[str, Estimate], extras: Sequence[ExtraEstimate] = ()
) -> dict[str, Any]:
    """Contents of `parameters.json`; standard errors and shares that the data do not determine are null.

    Args:
        robot: the robot.
        estimate: from all data.
        by_state: from the data of each contact state alone.
        extras: offsets, scales and actuator terms.
    """
    nominal = [{"nominal": _by_name(phi)} for phi in robot.nominal]
    identified = _by_body(robot, estimate, identified=estimate.phi)
    return {
        "units": dict(zip(PARAMETERS, PARAMETER_UNITS, strict=True)),
        "frame": "each body's link frame, inertia about its origin",
        "massless": list(robot.massless),
        "verdicts": estimate.verdict_counts(),
        "bodies": [{"name": body["name"]} | before | body for body, before in zip(identified, nominal, strict=True)],
        "extras": [_extra_entry(x) for x in extras],
        "contact_states": [
            {
                "name": name,
                "rank": alone.rank,
                "condition_number": _json_value(alone.condition_number),
                "singular_values": alone.singular_values.tolist(),
                "verdicts": alone.verdict_counts(),
                "bodies": _by_body(robot, alone),
            }
            for name, alone in by_state.items()
        ],
    }


def _by_body(robot: Robot, estimate: Estimate, **columns: np.ndarray) -> list[dict[str, Any]]:
    """Columns (12 L,) and the statistics of the estimate, by body and parameter."""
    columns |= {name: getattr(estimate, name) for name in ("standard_error", "identifiable", "data_share", "verdict")}
    parts = {name: getattr(estimate, name) for name in ("block_error", "kept_error", "gain_error")}
    known = {name: x for name, x in parts.items() if x is not None}
    if known:  # else the standard error is that by noise
        columns |= {"noise_error": estimate.noise_error} | known
    per_body = {name: x.reshape(-1, PER_BODY) for name, x in columns.items()}
    return [
        {"name": name} | {column: _by_name(values[body]) for column, values in per_body.items()}
        for body, name in enumerate(robot.body_names)
    ]


def _by_name(values: np.ndarray) -> dict[str, Any]:
    return {name: _json_value(x) for name, x in zip(PARAMETERS, values, strict=True)}


def _extra_entry(estimate: ExtraEstimate) -> dict[str, Any]:
    """An offset, scale or actuator term; `log` is null for one that is common to all logs."""
    extra = estimate.extra
    return {
        "what": extra.what,
        "name": extra.name,
        "component": extra.component or None,
        "log": estimate.log or None,
        "unit": extra.unit,
        "value": estimate.value,
        "nominal_value": estimate.nominal_value,
        "standard_error": _json_value(estimate.standard_error),
        "noise_error": _json_value(estimate.noise_error),
        "block_error": _json_value(estimate.block_error),
        "inflation": _json_value(estimate.inflation),
        "told_apart": estimate.separable,
        "mixed_with": list(estimate.confounded_with),
        "at_bound": estimate.at_bound,
        "label": extra.label,
    }


def _json_value(x: Any) -> float | bool | str | None:
    if isinstance(x, (str, np.bool_)):
        return str(x) if isinstance(x, str) else bool(x)
    return float(x) if np.isfinite(x) else None


def read_shared_extras(path: Path, column: str = "value") -> dict[str, float]:
    """Extra parameters that are common to all logs, by `Extra.label`, from the file of a run.

    Args:
        path: `parameters.json`.
        column: "value" or "nominal_value".

    Raises:
        InputError: the file is invalid.
    """
    entries = _read_document(path).get("extras", [])
    extras = {}
    for entry in entries if isinstance(entries, list) else [None]:
        if not (isinstance(entry, dict) and isinstance(entry.get("label"), str)):
            raise InputError(path, "extras", "an entry without a label", "a file written by torchid identify")
        value = _check_number(path, f"extras, {entry['label']}, {column}", entry.get(column))
        if entry.get("log") is None:
            extras[entry["label"]] = value
    return extras


def read_parameters(path: Path, robot: Robot) -> Array:
    """Identified parameters, (L, 12), from a `parameters.json` of the same robot.

    Raises:
        InputError: the file cannot be read or contains other bodies.
    """
    bodies = _read_document(path).get("bodies")
    bodies = bodies if isinstance(bodies, list) else []
    names = [body.get("name") if isinstance(body, dict) else None for body in bodies]
    if names != list(robot.body_names):
        raise InputError(path, "bodies", f"not the bodies of {robot.path}", ", ".join(robot.body_names))
    phi = []
    for body in bodies:
        values = body["identified"] if isinstance(body.get("identified"), dict) else {}
        field = f"body '{body['name']}', identified"
        phi.append([_check_number(path, f"{field}.{name}", values.get(name)) for name in PARAMETERS])
    return np.array(phi)


def _read_document(path: Path) -> dict[str, Any]:
    try:
        with during("reading", path):
            document = json.loads(read_bytes(path, MAX_JSON).decode())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "file", f"not readable as JSON ({error})", "a run's parameters.json") from error
    return document if isinstance(document, dict) else {}


def _check_number(path: Path, field: str, value: object) -> float:
    """The value as float; InputError unless it is a number of at most `_MAX_NUMBER`."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _MAX_NUMBER:
        raise InputError(path, field, f"{value!r}", "a number between -1e100 and 1e100")
    return float(value)


QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
_DIGITS = 4  # of correlations


def table_of_draws(samples: ParameterSamples) -> Array:
    """All samples, (N, 12 L + S), in the order of `FittedPosterior.parameter_names`."""
    parts = samples.phi.flatten(1), samples.extras
    return np.concatenate([part.cpu().numpy() for part in parts], axis=1)


def sample_arrays(
    fitted: FittedPosterior, samples: ParameterSamples, about: Mapping[str, float]
) -> dict[str, NDArray[Any]]:
    """What the file of samples holds, by name; `about` has numbers that say how they were drawn."""
    return {
        "samples": table_of_draws(samples),
        "names": np.array(fitted.parameter_names),
        "units": np.array(_units(fitted)),
        "nominal": np.append(fitted.posterior.nominal, np.full(len(fitted.extra_names), np.nan)),
        "body_names": np.array(fitted.body_names),
        "joint_names": np.array(fitted.joint_names),
        "parameter_names": np.array(PARAMETERS),
        **{name: np.array(value) for name, value in about.items()},
    }


def ranges_document(fitted: FittedPosterior, samples: ParameterSamples, about: Mapping[str, float]) -> dict[str, Any]:
    """Ranges of all parameters that are not fixed, and their correlations.

    Args:
        fitted: the posterior.
        samples: of it.
        about: numbers that say how they were drawn.
    """
    table = table_of_draws(samples)
    mean = table.mean(axis=0)
    deviation = table.std(axis=0)
    moving = np.flatnonzero(np.append(fitted.posterior.free, np.ones(len(fitted.extra_names), dtype=bool)))
    quantiles = np.quantile(table[:, moving], QUANTILES, axis=0)
    names = fitted.parameter_names
    units = _units(fitted)
    ranges = {}
    for column, number in enumerate(moving.tolist()):
        nominal = float(fitted.posterior.nominal[number]) if number < len(fitted.posterior.nominal) else None
        ranges[names[number]] = {
            "unit": units[number],
            "nominal": nominal,
            "mean": float(mean[number]),
            "standard_deviation": float(deviation[number]),
            "quantiles": quantiles[:, column].tolist(),
        }
    scaled = (table[:, moving] - mean[moving]) / np.where(deviation[moving] > 0.0, deviation[moving], 1.0)
    correlations = np.round(scaled.T @ scaled / len(table), _DIGITS)
    return {
        **about,
        "samples": len(table),
        "quantiles": list(QUANTILES),
        "parameters": ranges,
        "correlations": {"names": [names[number] for number in moving], "matrix": correlations.tolist()},
    }


def _units(fitted: FittedPosterior) -> tuple[str, ...]:
    return (*(PARAMETER_UNITS * (len(fitted.posterior.nominal) // PER_BODY)), *fitted.extra_units)
