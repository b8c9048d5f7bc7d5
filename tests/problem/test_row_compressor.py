"""Gram matrices of combined columns stand for rows as well as Householder QR does, or are not used."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from synthetic import Array
from torch import Tensor

from torchid import kernels
from torchid.problem import TriangularFactor
from torchid.problem import row_compressor as module
from torchid.problem.row_compressor import RowCompressor

COLUMNS = 12
PARAMETERS = np.linspace(-2.0, 3.0, COLUMNS)


def well_conditioned(rng: np.random.Generator, rows: int) -> Array:
    return rng.normal(size=(rows, COLUMNS)) * np.logspace(-4, 4, COLUMNS)


def nearly_dependent(rng: np.random.Generator, rows: int) -> Array:
    """Columns with condition 1e8, however they are scaled."""
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(COLUMNS, COLUMNS))).Q
    return rng.normal(size=(rows, COLUMNS)) * np.logspace(0, -8, COLUMNS) @ basis


def dependent(rng: np.random.Generator, rows: int) -> Array:
    """One column is a combination of two others, one is zero, one twice another."""
    A = rng.normal(size=(rows, COLUMNS))
    A[:, 3] = 0.3 * A[:, 7] - 2.0 * A[:, 1]
    A[:, 5] = 0.0
    A[:, 9] = 2.0 * A[:, 0]
    return A


KINDS = {"well conditioned": well_conditioned, "nearly dependent": nearly_dependent, "dependent": dependent}
kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


@pytest.fixture(autouse=True, params=["NumPy", "compiled"])
def combined_columns_of_short_chunks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of these tests are so short, and combine so many columns, that they would be factorized."""
    if request.param == "NumPy":
        monkeypatch.setattr(kernels, "compiled", lambda: None)
    monkeypatch.setattr(module, "_LEAST_ROWS", 0)
    monkeypatch.setattr(module, "_MOST_COMBINED", 1.0)


def with_room(rows: Array) -> Tensor:
    """Rows with room above them, for `RowCompressor.add`."""
    stacked = torch.full((COLUMNS + 1, COLUMNS + 1 + len(rows)), torch.nan, dtype=torch.float64).T
    stacked[COLUMNS + 1 :] = torch.from_numpy(rows)
    return stacked


def compressed(chunks: list[Array]) -> TriangularFactor:
    """The factor of chunks of rows (M, COLUMNS + 1)."""
    compressor = RowCompressor(TriangularFactor(COLUMNS))
    for rows in chunks:
        compressor.add(tuple(range(COLUMNS)), with_room(rows))
    compressor.finish()
    return compressor.factor


def exact_rows(kind: Callable[[np.random.Generator, int], Array], chunks: int, noise: float = 0.0) -> list[Array]:
    rng, out = np.random.default_rng(0), []
    for _ in range(chunks):
        A = kind(rng, 300)
        out.append(np.column_stack([A, A @ PARAMETERS + noise * rng.normal(size=len(A))]))
    return out


def relative_difference(R: Array, rows: Array) -> float:
    """The largest relative difference between ||R x|| and ||rows x||, of all x that rows do not map to rounding."""
    U, values, Vh = np.linalg.svd(rows / (size := np.linalg.norm(rows, axis=0) + 1e-300), full_matrices=False)
    known = values > 1e-12 * values[0]
    unit = Vh[known].T / values[known]
    return float(np.abs(np.linalg.svd((R / size) @ unit, compute_uv=False) - 1.0).max())


@kinds
@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_the_factor_has_the_lengths_of_the_rows(
    kind: Callable[[np.random.Generator, int], Array], noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunks = exact_rows(kind, 4, noise)
    by_qr = np.linalg.qr(np.vstack(chunks), mode="r")
    monkeypatch.setattr(RowCompressor, "_factorize", None)  # all are summed
    factor = compressed(chunks)
    assert factor.rows == 1200
    R = factor.triangle().numpy()
    limit = 10.0 * relative_difference(by_qr, np.vstack(chunks)) + 1e-12
    assert relative_difference(R, np.vstack(chunks)) < limit


def test_rows_that_columns_were_not_combined_for_are_factorized_and_columns_combined_anew() -> None:
    rng, factorized = np.random.default_rng(3), 0
    still = rng.normal(size=(200, 3)) @ rng.normal(size=(3, COLUMNS + 1))  # as of a robot that holds a pose
    chunks = [still + 1e-9 * rng.normal(size=still.shape), *exact_rows(nearly_dependent, 3, 1e-3)]
    chunks[2] = 1e6 * chunks[2][:, ::-1]

    class Counted(RowCompressor):
        def _factorize(self, *args: object) -> None:
            nonlocal factorized
            factorized += 1
            super()._factorize(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(globals(), "RowCompressor", Counted)
        factor = compressed(chunks)
    rows = np.vstack(chunks)
    assert 0 < factorized < len(chunks)
    limit = 10.0 * relative_difference(np.linalg.qr(rows, mode="r"), rows) + 1e-12
    assert relative_difference(factor.triangle().numpy(), rows) < limit


@pytest.mark.parametrize("small", [1e-3, 1e-12, 1e-70])
def test_a_column_that_the_sampled_rows_hardly_have_takes_no_digits_of_others(small: float) -> None:
    """As friction that only slow samples show: its combination for these alone would be as large as it is small."""
    chunks = exact_rows(well_conditioned, 3)
    for rows in chunks:
        rows[:: 300 // (3 * (COLUMNS + 1)), 4] *= small
        rows[:, -1] = rows[:, :-1] @ PARAMETERS
    assert relative_difference(compressed(chunks).triangle().numpy(), np.vstack(chunks)) < 1e-12


@pytest.mark.parametrize("number", [np.nan, np.inf])
@pytest.mark.parametrize("chunk", [0, 2])
def test_numbers_that_are_not_finite_reach_the_factor(number: float, chunk: int) -> None:
    chunks = exact_rows(well_conditioned, 4)
    chunks[chunk][17, 4] = number
    assert not compressed(chunks).triangle().isfinite().all()
