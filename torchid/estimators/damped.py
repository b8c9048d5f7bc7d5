"""Systems of linear equations whose matrix rounding may have made singular."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def damped_inverse(A: Tensor) -> Callable[[Tensor], Tensor]:
    """B -> A^-1 b for A positive semidefinite, (n, n), with the least damping that works (Levenberg)."""
    scale = A.diagonal().abs().clamp_min(torch.finfo(A.dtype).tiny).rsqrt()
    scaled = scale[:, None] * A * scale
    damping = 0.0
    while True:
        root, failed = torch.linalg.cholesky_ex(scaled + damping * torch.eye(len(A), dtype=A.dtype))
        if not failed:
            return lambda b: scale * torch.cholesky_solve((scale * b)[:, None], root)[:, 0]
        damping = max(1e-15, 10.0 * damping)
