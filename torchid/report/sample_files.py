"""Files of samples of a posterior: arrays with names, and ranges with correlations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.fitting.posterior import FittedPosterior, ParameterSamples
from torchid.parameters import PARAMETER_UNITS, PARAMETERS, PER_BODY, Array

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
    mean, deviation = table.mean(axis=0), table.std(axis=0)
    moving = np.flatnonzero(np.append(fitted.posterior.free, np.ones(len(fitted.extra_names), dtype=bool)))
    quantiles = np.quantile(table[:, moving], QUANTILES, axis=0)
    names, units = fitted.parameter_names, _units(fitted)
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
