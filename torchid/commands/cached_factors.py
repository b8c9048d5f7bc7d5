"""Factors of training logs in a cache: a later fit with another ridge or estimator makes no pass over their samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid import ranks
from torchid.commands.cache import Cache, Entry, content_key, tensor_of
from torchid.fitting.experiment import Experiment
from torchid.problem import RowBuilder, Samples, TriangularFactor
from torchid.problem.chunks import worker_count
from torchid.problem.compression import Part

_FORMAT = 1  # of entries


def factors_key(experiment: Experiment, builder: RowBuilder, samples: Sequence[str], blocks: Sequence[Samples]) -> str:
    """The name of the factors of training logs: of whatever changes the last bit of one.

    Args:
        experiment: with the noise that rows are weighed with.
        builder: of the rows.
        samples: names of the samples of each log, see `CachedReader.keys`.
        blocks: the logs in folds.
    """
    sensors, sources = experiment.sensors, list(dict.fromkeys(block.source for block in blocks))
    return content_key(
        {
            "format": _FORMAT,
            "samples": list(samples),
            "sensors": [sensors.torque.tolist(), sensors.wrench.tolist()],
            "noise": vars(sensors.noise),
            "terms": vars(experiment.terms),
            "blocks": [[sources.index(block.source), len(block), block.fold] for block in blocks],
            "device": builder.device.type,
            "shares": [worker_count(builder.device), ranks.world_size()],  # rows are added up by each
        }
    )


def cached_parts(
    cache: Cache, key: str, builder: RowBuilder, blocks: Sequence[Samples], compute: Callable[[], list[Part]]
) -> tuple[list[Part], bool]:
    """The parts of blocks of logs from a cache, or computed and stored; whether they were there.

    All processes that share the work call this together.

    Args:
        cache: where they may be.
        key: from `factors_key`.
        builder: of the rows.
        blocks: the logs in folds.
        compute: compresses them.
    """
    sources = list(dict.fromkeys(block.source for block in blocks))
    entry, found = cache.load(key), None
    if entry is not None:
        try:
            found = _unpacked(entry, builder, sources)
        except Exception as error:  # noqa: B902 - whatever another program has put there
            cache.drop(key, str(error))
    there = all(ranks.gather(found is not None, "factors in the cache"))
    if there and found is not None:
        return found, True
    parts = compute()
    if ranks.is_first():
        cache.save(key, *_packed(parts, sources))
    return parts, False


def _packed(parts: Sequence[Part], sources: Sequence[str]) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The document and the numbers of an entry, those of all triangles one after the other."""
    values: list[NDArray[Any]] = [np.empty(0)]
    entries = []
    for part in parts:
        factor, triangles = part.factor, []
        for support, block in factor.blocks.items():
            values.append(block.cpu().numpy().ravel())
            triangles.append([list(support), len(block)])
        entries.append(
            {
                "source": sources.index(part.source),
                "state": list(part.state),
                "samples": part.samples,
                "fold": part.fold,
                "block": part.block,
                "unloaded": part.unloaded,
                "gated": sorted(part.gated),
                "rows": factor.rows,
                "independent_rows": factor.independent_rows,
                "triangles": triangles,
            }
        )
    return {"parts": entries}, {"values": np.concatenate(values)}


def _unpacked(entry: Entry, builder: RowBuilder, sources: Sequence[str]) -> list[Part]:
    """What was stored, of logs of these names; any exception where that is something else."""
    values, taken, parts = entry.arrays["values"], 0, []
    for one in entry.document["parts"]:
        blocks = {}
        for support, rows in one["triangles"]:
            size = rows * (len(support) + 1)
            block = values[taken : taken + size].reshape(rows, len(support) + 1)
            blocks[tuple(support)] = tensor_of(block).clone().to(builder.device)
            taken += size
        factor = TriangularFactor.from_blocks(builder.width, one["rows"], one["independent_rows"], blocks)
        plain = {name: one[name] for name in ("samples", "fold", "block", "unloaded")}
        parts.append(Part(sources[one["source"]], tuple(one["state"]), factor, gated=set(one["gated"]), **plain))
    if taken != len(values):
        raise ValueError("more numbers than are described")
    return parts
