"""Buffers that one worker reuses from chunk to chunk: fresh large tensors cost as much as the arithmetic."""

from __future__ import annotations

import torch
from torch import Tensor


class Workspace:
    """Named buffers, one worker's alone. Keeps the latest of each name only."""

    def __init__(self) -> None:
        """Start empty."""
        self._buffers: dict[str, Tensor] = {}

    def zeros(self, name: str, like: Tensor, *shape: int) -> Tensor:
        """A buffer that is zero wherever callers with the same name and shape never write."""
        found = self._buffers.get(name)
        if found is None or (found.shape, found.dtype, found.device) != (shape, like.dtype, like.device):
            found = self._buffers[name] = torch.zeros(shape, dtype=like.dtype, device=like.device)
        return found
