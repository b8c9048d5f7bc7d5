"""Buffers that one worker reuses from chunk to chunk: fresh large tensors cost as much as the arithmetic."""

from __future__ import annotations

from collections.abc import Hashable

import torch
from torch import Tensor


class Workspace:
    """Named buffers, zero when new; one worker's alone. Keeps the latest of each name only."""

    def __init__(self) -> None:
        """Start empty."""
        self._buffers: dict[str, tuple[Hashable, Tensor]] = {}

    def zeros(self, name: str, pattern: Hashable, like: Tensor, *shape: int) -> Tensor:
        """A buffer that is zero wherever callers with the same `pattern` never write."""
        key = (pattern, shape, like.dtype, like.device)
        found = self._buffers.get(name)
        if found is None or found[0] != key:
            found = (key, torch.zeros(shape, dtype=like.dtype, device=like.device))
            self._buffers[name] = found
        return found[1]
