"""Logs compressed one by one are cut into folds as their samples would be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from thinned import study_but
from walking import MACHINES, recorded, robot_of, truth

from torchid.logs.preprocess import preprocess
from torchid.problem import ExtraTerms, RowBuilder, Samples, TriangularFactor, bind_log, compress_parts
from torchid.problem.compression import (
    BY_FOLD,
    FOLDS,
    LEAST_PER_FOLD,
    Part,
    block_spans,
    compress_in_blocks,
    compress_log,
    fold_compressed,
    merge,
    split_into_folds,
)
from torchid.sensing import named_sensors


@pytest.fixture(scope="module")
def walk() -> tuple[RowBuilder, Samples]:
    """A biped with offsets in its soles, which are lifted."""
    machine = MACHINES["biped"]
    robot, contacts = robot_of(machine), machine.contacts
    sensors = named_sensors("full", robot.n, len(contacts))
    log = preprocess(recorded(machine, truth(machine, 1, seconds=8.0)), 10.0)
    builder = RowBuilder(robot, contacts, sensors, ExtraTerms(offsets={"contact_force": "log"}))
    return builder, bind_log(log, robot, contacts, sensors)


def logs_of(walk: Samples, lengths: Sequence[int]) -> list[Samples]:
    starts = np.cumsum([0, *lengths])
    assert starts[-1] <= len(walk)
    return [replace(walk[a:b], source=str(a)) for a, b in zip(starts, starts[1:], strict=False)]


def gram(factor: TriangularFactor) -> torch.Tensor:
    R = factor.triangle()
    return R.T @ R


def assert_same(found: Sequence[Part], expected: Sequence[Part]) -> None:
    def by_key(parts: Sequence[Part], of_state: bool) -> dict[tuple[object, ...], Part]:
        return {(x.source, x.fold, x.unloaded, x.state if of_state else None): x for x in parts}

    for unloaded in (False, True):
        one, other = (by_key([x for x in parts if x.unloaded == unloaded], unloaded) for parts in (found, expected))
        assert one.keys() == other.keys()
        for key, part in one.items():
            same, G = other[key], gram(other[key].factor)
            assert (part.samples, part.factor.rows, part.masked) == (same.samples, same.factor.rows, same.masked)
            assert part.factor.independent_rows == pytest.approx(same.factor.independent_rows, rel=1e-12)
            assert (gram(part.factor) - G).abs().max() <= 1e-12 * G.abs().max()


@pytest.mark.parametrize(
    "case",
    study_but(
        [((1500,), 1.0), ((100,) * 14, 1.0), ((700, 30, 700), 1.0), ((500, 1000), 25.0)],
        [
            *(((1500,), 1.0), ((700, 800), 1.0), ((750, 750), 1.0), ((1200, 150, 150), 1.0), ((300, 1200), 1.0)),
            *(((100,) * 14, 1.0), ((700, 30, 700), 1.0), ((500, 1000), 25.0), ((1500,), 20.0)),
        ],
    ),
)
def test_blocks_of_compressed_logs_are_those_of_their_samples(
    walk: tuple[RowBuilder, Samples], case: tuple[Sequence[int], float]
) -> None:
    """Logs that are cut or held out as a whole, and readings in the air, whose means are of whole blocks.

    Of samples that are too close for noise of their own fewer folds are made.
    """
    (builder, samples), (lengths, oversampling) = walk, case
    logs = [replace(log, oversampling=oversampling) for log in logs_of(samples, lengths)]
    expected = split_into_folds(logs, builder)
    found = fold_compressed([compress_log(log, builder) for log in logs], builder)
    assert [(x.source, x.fold, len(x)) for x in found] == [(x.source, x.fold, len(x)) for x in expected]
    assert oversampling == 1.0 or len({x.fold for x in found}) == 1500 // (LEAST_PER_FOLD * oversampling) < FOLDS
    parts = compress_parts(expected, builder)
    merged = merge([part for part in parts if not part.unloaded], builder, *BY_FOLD)
    unloaded = [part for part in parts if part.unloaded]
    assert unloaded
    cut = [part for block in found for part in block.parts]
    loaded = [part for part in cut if not part.unloaded]
    assert len({(part.source, part.fold, part.block) for part in loaded}) == len(loaded) >= len(merged)
    assert_same([*merge(loaded, builder, *BY_FOLD), *(part for part in cut if part.unloaded)], [*merged, *unloaded])


def test_contact_states_of_a_compressed_log_are_those_of_its_samples(walk: tuple[RowBuilder, Samples]) -> None:
    builder, log = walk
    parts = [part for part in compress_parts([log], builder) if not part.unloaded]
    expected = {part.state: part for part in parts}
    found = {part.state: part for part in compress_log(log, builder).by_state}
    assert found.keys() == expected.keys()
    assert len(found) > 1
    for state, part in found.items():
        G = gram(expected[state].factor)
        assert part.samples == expected[state].samples
        assert (gram(part.factor) - G).abs().max() <= 1e-12 * G.abs().max()


def test_blocks_whose_rows_are_made_at_once_are_those_of_pieces(walk: tuple[RowBuilder, Samples]) -> None:
    builder, log = walk
    folds = split_into_folds([log], builder)
    blocks = [part for part in compress_in_blocks(folds, builder) if not part.unloaded]
    assert len({(part.fold, part.block) for part in blocks}) > FOLDS
    for part in blocks:
        fold = replace(folds[part.fold], unloaded=None)
        count = 1 + max(other.block for other in blocks if other.fold == part.fold)
        start, stop = block_spans(len(fold), count)[part.block]
        (piece,) = (x for x in compress_parts([fold[start:stop]], builder) if x.state == part.state)
        assert (part.samples, part.factor.rows) == (piece.samples, piece.factor.rows)
        assert part.factor.independent_rows == pytest.approx(piece.factor.independent_rows)
        G = gram(piece.factor)
        assert (gram(part.factor) - G).abs().max() <= 1e-12 * G.abs().max()
