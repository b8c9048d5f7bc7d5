"""Condemned samples left out of a bound log, visibly."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch

from torchid.errors import LogError, TorchidWarning
from torchid.hygiene.channels import median_step
from torchid.hygiene.check import Checked
from torchid.hygiene.finding import CONDEMNED
from torchid.logs.fields import BoolArray, FloatArray
from torchid.logs.plan import DROPPED_SAMPLES, REACH_PERIODS
from torchid.logs.timeline import JITTER
from torchid.problem import Samples

_NAMED = 4


def excluded(checked: Checked, time: FloatArray, cutoff_hz: float | None, derived: bool) -> BoolArray:
    """Which stamps (K,) [s] of a preprocessed log condemned samples reach.

    Args:
        checked: the log as recorded.
        time: of the preprocessed log.
        cutoff_hz: of the filter, which smears a sample over its reach to either side; None without one.
        derived: whether anything was filtered, differentiated or resampled, which takes neighbours along.
    """
    step = median_step(checked.log)
    margin = JITTER * step + (DROPPED_SAMPLES * step if derived else 0.0)
    if cutoff_hz is not None:
        margin += REACH_PERIODS / cutoff_hz
    condemned = checked.log.time[checked.condemned]
    nearest = np.searchsorted(condemned, time)
    padded = np.concatenate([[-np.inf], condemned, [np.inf]])
    return np.asarray((time - padded[nearest] <= margin) | (padded[nearest + 1] - time <= margin))


def without_condemned(samples: Samples, checked: Checked, cutoff_hz: float | None, derived: bool) -> Samples:
    """The samples that condemned ones do not reach; see `excluded`.

    Raises:
        LogError: the log is not usable, or nothing is left.

    Warns:
        TorchidWarning: how many samples were left out, and why.
    """
    source = samples.source
    if not checked.usable:
        accepted = "a log that torchid check finds usable, or preprocessing.exclude_condemned: false"
        raise LogError(source, "preprocessing.exclude_condemned", checked.verdict, accepted)
    gone = excluded(checked, samples.time.cpu().numpy(), cutoff_hz, derived)
    if not gone.any():
        return samples
    reasons = _reasons(checked)
    if gone.all():
        raise LogError(source, "preprocessing.exclude_condemned", f"no sample left: {reasons}", "a longer log")
    message = f"{Path(source).name}: {gone.sum()} of {len(samples)} samples excluded: {reasons}"
    warnings.warn(message, TorchidWarning, stacklevel=3)
    return samples[torch.from_numpy(np.flatnonzero(~gone))]


def _reasons(checked: Checked) -> str:
    """What condemns samples, and where."""
    found = []
    for finding in checked.findings:
        if finding.severity == CONDEMNED:
            spans = list(dict.fromkeys(str(span) for span in finding.spans))
            more = f" and {len(spans) - _NAMED} more" if len(spans) > _NAMED else ""
            found.append(f"{finding.field} {finding.name} at samples {', '.join(spans[:_NAMED])}{more}")
    return "; ".join(found)
