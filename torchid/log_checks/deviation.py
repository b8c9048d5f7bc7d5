"""Unknowns that the URDF does not have, such as a lag or a tilt, estimated beside all URDFs near the given one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from torchid.log_checks.model import (
    MAX_TRIAL_DIFFERENTIATED_SAMPLES,
    NominalModel,
    bind_some_samples,
    deviation_builder,
    preprocess_pieces,
)
from torchid.log_checks.scales import (
    CORRELATED_SAMPLES,
    MIN_BLOCK_SHARE,
    MIN_STANDARD_DEVIATIONS,
    TIME_BLOCKS,
    NormalEquations,
    accumulate_blocks,
    deviation_columns,
    prior_columns,
    rows_with_bases,
)
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.problem import RowBuilder, Samples

COMPARED_SAMPLES = 240
"""Samples of a log whose forces are compared."""

#: Unexplained forces without the deviation over those with it (1.2 at most in logs without a mistake), and what it may
#: leave: more, and the forces are another robot's.
MIN_UNEXPLAINED_RATIO, MAX_LEFT = 1.25, 1.5

UnknownColumns = Callable[[RowBuilder, Samples, int], FloatArray]
"""Change of the generalized forces that are required (N, n_rows, k) by a unit of each unknown, of samples by number."""


@dataclass(frozen=True, eq=False)
class FilteredLog:
    """Some filtered samples of a log, with their rows, for all that may be wrong with it.

    Attributes:
        log: the log.
        model: robot, contacts, and what is declared.
        cutoff_hz: of the filter.
    """

    log: Log
    model: NominalModel
    cutoff_hz: float

    @cached_property
    def pieces(self) -> list[Log]:
        """Runs of the log, filtered. Raises InputError: it cannot be filtered."""
        return preprocess_pieces(self.log, self.cutoff_hz, MAX_TRIAL_DIFFERENTIATED_SAMPLES)

    @cached_property
    def samples(self) -> list[Samples]:
        """Samples of them. Raises InputError: as `pieces`, or the log does not match the robot."""
        return bind_some_samples(self.pieces, self.model.robot, self.model.contacts, COMPARED_SAMPLES)

    @cached_property
    def rows(self) -> DeviationRows | None:
        """Rows of the samples, None where no force was measured. Raises InputError: as `samples`."""
        return DeviationRows.of(self.samples, self.model)


@dataclass(frozen=True, eq=False)
class DeviationRows:
    """Whitened rows of some samples, and columns of what may differ from the URDF in them.

    Attributes:
        builder: of the rows.
        samples: that they are of.
        parts: of each of the samples, bases W (N, n_rows, r), which of the r rows are not zero, columns (N, r, P),
            those of offsets of torques last, and what the nominal parameters leave (N, r).
    """

    builder: RowBuilder
    samples: Sequence[Samples]
    parts: list[tuple[FloatArray, BoolArray, FloatArray, FloatArray]]

    @classmethod
    def of(
        cls, samples: Sequence[Samples], model: NominalModel, torque_noise: FloatArray | None = None
    ) -> DeviationRows | None:
        """The rows of the forces that are measured, None without any; `torque_noise` as of `deviation_builder`."""
        builder = deviation_builder(samples, model, torque_noise)
        if builder is None:
            return None
        prior, parts = prior_columns(builder, model.robot, samples), []
        nominal = builder.to_columns(model.robot.nominal.flatten()[None])[0].numpy()
        for part in samples:
            rows, W, equations = rows_with_bases(builder, part)
            columns = deviation_columns(builder, rows, W, part, prior)
            parts.append((W, equations, columns, rows[..., :-1] @ nominal - rows[..., -1]))
        return cls(builder, samples, parts)

    @cached_property
    def unexplained(self) -> float:
        """What the best URDF near the given one leaves of the forces, as `Deviation.without`."""
        normal = accumulate_blocks([(K, target[..., None], equations) for _, equations, K, target in self.parts])
        return float(np.sqrt(max(float(normal.unexplained()[0, 0]), 0.0) / max(normal.rows, 1)))


@dataclass(frozen=True, eq=False)
class Deviation:
    """Unknowns beside the parameters, estimated with these.

    Attributes:
        value, spread: (k,), of the whole log, and their standard deviations.
        blocks: (TIME_BLOCKS, k), by block of time.
        without, left: forces that the best URDF near the given one leaves unexplained without the unknowns and with
            them, rms in `UNMODELLED_FORCE_SHARE` of the forces.
    """

    value: FloatArray
    spread: FloatArray
    blocks: FloatArray
    without: float
    left: float

    @property
    def clear(self) -> BoolArray:
        """Unknowns (k,) that are certain and that every block agrees on, where all explain the forces much better."""
        return np.asarray(self.steady & self.certain & self.improves)

    @property
    def steady(self) -> BoolArray:
        """Unknowns (k,) that every block of time agrees on."""
        return np.asarray((self.blocks * np.sign(self.value) > MIN_BLOCK_SHARE * np.abs(self.value)).all(axis=0))

    @property
    def certain(self) -> BoolArray:
        """Unknowns (k,) that are not 0 by their standard deviations."""
        return np.asarray(np.abs(self.value) > MIN_STANDARD_DEVIATIONS * self.spread)

    @property
    def improves(self) -> bool:
        """Whether all unknowns together explain the forces much better."""
        return self.without > MIN_UNEXPLAINED_RATIO * self.left and self.left < MAX_LEFT

    @property
    def explained(self) -> float:
        """By how much less all unknowns together leave, squared."""
        return self.without**2 - self.left**2

    @property
    def is_clear(self) -> bool:
        """Whether the largest unknown is."""
        return bool(self.clear[np.argmax(np.abs(self.value))])

    @property
    def gain(self) -> str:
        """How much better forces are explained with it."""
        return f"{self.without / max(self.left, 1e-9):.2g} times as much is unexplained otherwise"


@dataclass(frozen=True, eq=False)
class UnknownEquations:
    """Equations of unknowns by their columns, beside all that may differ from the URDF.

    `normal`: of what the nominal parameters leave, and of the k unknowns, in this order.
    """

    normal: NormalEquations

    @classmethod
    def of(cls, rows: DeviationRows, columns: UnknownColumns, offsets: int = 0) -> UnknownEquations:
        """Of all samples of the rows; see `fit_deviation`."""
        parts = []
        for number, (part, (W, equations, K, target)) in enumerate(zip(rows.samples, rows.parts, strict=True)):
            projected = np.einsum("nvr,nvk->nrk", W, columns(rows.builder, part, number))
            Y = np.concatenate([target[..., None], projected], axis=2)
            parts.append((K[..., : K.shape[2] - offsets], Y, equations))
        return cls(accumulate_blocks(parts))

    @cached_property
    def _products(self) -> dict[int | None, FloatArray]:
        """Of what the parameters leave (1 + k, 1 + k), of the whole log and by block of time."""
        return {block: self.normal.unexplained(block) for block in (None, *range(TIME_BLOCKS))}

    @property
    def unexplained_without(self) -> float:
        """As `Deviation.without`."""
        return self._rms(float(self._products[None][0, 0]))

    def _rms(self, squares: float) -> float:
        return float(np.sqrt(max(squares, 0.0) / max(self.normal.rows, 1)))

    def with_unmodelled(self, ratio: float) -> UnknownEquations:
        """The equations where forces that no parameters explain are `ratio` times what was presumed."""
        one = self.normal
        return UnknownEquations(replace(one, KtK=one.KtK / ratio**2, KtY=one.KtY / ratio**2, YtY=one.YtY / ratio**2))

    def fit(self, prior_std: float, combined: FloatArray | None = None) -> Deviation:
        """The unknowns, or those whose columns are `combined` (k, m) of them, with their prior standard deviation."""
        map_ = np.eye(self.normal.YtY.shape[1]) if combined is None else block_diag(1.0, combined)

        def solve(block: int | None) -> tuple[FloatArray, FloatArray, float]:
            G = map_.T @ self._products[block] @ map_
            H = G[1:, 1:] + CORRELATED_SAMPLES / prior_std**2 * np.eye(len(G) - 1)
            x = np.linalg.solve(H, G[1:, 0])
            left = G[0, 0] - 2.0 * G[0, 1:] @ x + x @ G[1:, 1:] @ x
            return np.asarray(x), np.asarray(np.diag(np.linalg.inv(H))), float(left)

        value, variance, squares = solve(None)
        left = self._rms(squares)
        spread = np.sqrt(CORRELATED_SAMPLES * max(1.0, left**2) * variance)
        blocks = np.array([solve(block)[0] for block in range(TIME_BLOCKS)])
        return Deviation(value, spread, blocks, self.unexplained_without, left)


def fit_deviation(
    rows: DeviationRows | None, columns: UnknownColumns, prior_std: float, offsets: int = 0
) -> Deviation | None:
    """Unknowns by their columns, beside parameters, friction, armature and all but so many `offsets` of torques."""
    return None if rows is None else UnknownEquations.of(rows, columns, offsets).fit(prior_std)
