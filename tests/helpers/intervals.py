"""Repeated noise, and whether the intervals of estimates hold the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from synthetic import Array

from torchid.estimators import Estimate
from torchid.problem import RowBuilder, Samples
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


def noisy_torques(samples: Samples, builder: RowBuilder, rng: np.random.Generator) -> Iterator[Samples]:
    """The log again and again, with noise of the torque sensors and unknown forces on the base.

    Unmeasured feet bear what pushes the base; joints hold the feet.
    """
    noise, J = builder.sensors.noise, builder.contact_jacobian(samples)[:, :, :3].flatten(1, 2).numpy()
    J = J * np.repeat(samples.active.numpy(), 3, axis=1)[..., None]
    borne = -np.linalg.pinv(J[:, :, :6].transpose(0, 2, 1), rcond=1e-9)  # (N, k, 6)
    held = -J[:, :, 6:].transpose(0, 2, 1) @ borne  # (N, n, 6)
    assert samples.torque is not None
    while True:
        pushes = noise.base_std * rng.normal(size=(len(samples), 6))
        error = noise.joint_torque * rng.normal(size=samples.torque.shape) + (held @ pushes[..., None])[..., 0]
        yield replace(samples, torque=samples.torque + torch.from_numpy(error))
