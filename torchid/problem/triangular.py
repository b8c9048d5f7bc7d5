"""Triangular factors: all that is kept of any number of rows."""

from __future__ import annotations

import torch
from torch import Tensor


class TriangularFactor:
    """R with `R^T R = X^T X` for all rows X added so far, right-hand side as the last column.

    Rows that are zero outside a few columns are kept in a block of their own with just these columns. Memory is of the
    order of the columns squared, whatever the number of rows, and Householder factorizations keep the full accuracy of
    the rows (a Gram matrix would square the condition number). Factors of parts of the data merge into the factor of
    all of it.
    """

    def __init__(self, columns: int) -> None:
        """Start empty, for `columns` columns and one right-hand side."""
        self.columns = columns
        self.rows = 0
        self.independent_rows = 0.0
        self._blocks: dict[tuple[int, ...], Tensor] = {}
        self._scratch: Tensor | None = None

    @property
    def oversampling(self) -> float:
        """Rows per independent row, 1 without any."""
        return max(1.0, self.rows / self.independent_rows) if self.rows else 1.0

    def add(self, support: tuple[int, ...], rows: Tensor, oversampling: float = 1.0) -> None:
        """Add rows.

        Args:
            support: the columns in which they are not zero.
            rows: (M, len(support) + 1), right-hand side last.
            oversampling: of them that noise makes one independent row, at least 1.
        """
        self.rows += rows.shape[0]
        self.independent_rows += rows.shape[0] / oversampling
        self._absorb(support, rows)

    def merge(self, other: TriangularFactor) -> None:
        """Add everything that another factor has seen.

        Raises:
            ValueError: the factors differ in columns.
        """
        if other.columns != self.columns:
            raise ValueError(f"merge: found a factor of {other.columns} columns; accepted: {self.columns} columns")
        self.rows += other.rows
        self.independent_rows += other.independent_rows
        for support, block in other._blocks.items():
            self._absorb(support, block)

    def times(self, factor: float) -> TriangularFactor:
        """The factor of the same rows, larger by a factor."""
        out = TriangularFactor(self.columns)
        out.rows, out.independent_rows = self.rows, self.independent_rows
        out._blocks = {support: factor * block for support, block in self._blocks.items()}
        return out

    def triangle(self) -> Tensor:
        """Upper triangular R, (columns + 1, columns + 1), float64 on the CPU."""
        total = torch.zeros(self.columns + 1, self.columns + 1, dtype=torch.float64)
        scattered = [total]
        for support, block in self._blocks.items():
            wide = torch.zeros(block.shape[0], self.columns + 1, dtype=torch.float64)
            wide[:, [*support, self.columns]] = block.to("cpu", torch.float64)
            scattered.append(wide)
        return torch.linalg.qr(torch.cat(scattered), mode="r").R

    @torch.no_grad()
    def _absorb(self, support: tuple[int, ...], rows: Tensor) -> None:
        kept = self._blocks.get(support)
        above, width = (0 if kept is None else kept.shape[0]), rows.shape[1]
        count = above + rows.shape[0]
        if count < width:
            self._blocks[support] = rows.clone() if kept is None else torch.cat([kept, rows])
            return
        if self._scratch is None or self._scratch.numel() < count * width:
            self._scratch = rows.new_empty(count * width)
        stacked = self._scratch[: count * width].view(width, count)  # columns contiguous: LAPACK works in place
        if kept is not None:
            stacked[:, :above] = kept.T
        stacked[:, above:] = rows.T
        torch.geqrf(stacked.T, out=(stacked.T, rows.new_empty(width)))
        self._blocks[support] = stacked[:, :width].T.triu()
