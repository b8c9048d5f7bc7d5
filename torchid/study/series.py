"""Forces over time on the unseen log, as the study's figures show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchid.parameters import Array
from torchid.problem import Samples
from torchid.problem.predict import force_series, in_null_space
from torchid.report.metrics import BASE_ROWS, Evaluation


@dataclass(frozen=True)
class Series:
    """Generalized forces of one log: `true` (N, nv) and what every parameter vector predicts.

    `projected_true` and `projected` are the same inside the contacts' null space, V_x V_x^T f. `rows`: names of the nv
    rows.
    """

    time: Array
    rows: tuple[str, ...]
    true: Array
    predicted: Mapping[str, Array]
    projected_true: Array
    projected: Mapping[str, Array]

    def row(self, name: str) -> int:
        """Place of a row."""
        return self.rows.index(name)


def series_of(evaluation: Evaluation, samples: Samples, phi: Mapping[str, Array]) -> Series:
    """Forces of a log and the predictions of named parameter vectors (12 L,)."""
    true, predicted = force_series(evaluation.builder, samples, np.stack(list(phi.values())))
    inside = in_null_space(evaluation.builder, samples, np.concatenate([true[None], predicted]))
    return Series(
        samples.time.numpy() - float(samples.time[0]),
        (*BASE_ROWS, *evaluation.robot.joint_names),
        true,
        dict(zip(phi, predicted, strict=True)),
        inside[0],
        dict(zip(phi, inside[1:], strict=True)),
    )
