"""The rows of a fit in units of forces: what is left of measured and predicted ones in the projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torchid.parameters import Array
from torchid.problem.chunks import chunks_by_state, one_thread
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples

_CHUNK = 512  # samples: rows are dense here


@dataclass(frozen=True)
class ProjectedForces:
    """Generalized forces V_x V_x^T f of a log, rows as in K, with what a fit predicts of them [N, N m].

    `measured`, (N, n_rows), as recorded: predictions have offsets and scales. `predicted`, (M, N, n_rows). `noise`,
    (N, n_rows): standard deviation that the noise of the readings gives the measured. NaN where readings lack, and in
    rows that no reading is of.
    """

    measured: Array
    predicted: Array
    noise: Array


def projected_forces(builder: RowBuilder, samples: Samples, phi: torch.Tensor) -> ProjectedForces:
    """The rows of a fit, W^T [K phi, f], mapped back by W (W^T W)^-1, whose span is that of V_x.

    Args:
        builder: of the rows.
        samples: of one log.
        phi: (M, width), parameters in the builder's columns, extra ones included.
    """
    shape = len(samples), builder.tree.n_rows
    measured, noise, predicted = np.empty(shape), np.empty(shape), np.empty((len(phi), *shape))
    with torch.no_grad(), one_thread():
        for state, index in chunks_by_state(samples, _CHUNK):
            chunk = samples[index].to(builder.device)
            rows, W = builder.rows_by_sample(chunk, state)
            gram = W.mT @ W
            gram.diagonal(dim1=1, dim2=2)[(W == 0.0).all(1)] = 1.0  # of samples with fewer rows
            back = torch.linalg.solve(gram, W.mT).mT
            forces = back @ torch.cat([rows[..., -1:], rows[..., :-1] @ phi.T], dim=2)
            forces[(W == 0.0).all(2)] = torch.nan
            where = index if isinstance(index, slice) else index.numpy()
            measured[where] = forces[..., 0].cpu().numpy()
            predicted[:, where] = forces[..., 1:].permute(2, 0, 1).cpu().numpy()
            noise[where] = (back.square().sum(2) / chunk.oversampling).sqrt().cpu().numpy()
    return ProjectedForces(measured, predicted, noise)
