"""Repeated noise, and whether the intervals of estimates hold the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from synthetic import Array

from torchid.estimators import Estimate
from torchid.sensing import Contact

REPETITIONS = 200


NORMAL = 1.959964


def covered(estimates: list[Estimate], true: Array) -> NDArray[np.bool_]:
    """Whether each 95 % interval by noise holds the truth, (repetitions, identified parameters)."""
    known = estimates[0].verdict == "identified"
    off = np.array([(estimate.phi - true) / estimate.noise_error for estimate in estimates])
    return np.abs(off[:, known]) <= NORMAL


FEET = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))


STATES = [[True] * 4, [False, True, True, True], [True, True, False, True]]
