"""Factors of training logs in a cache: a later fit with another ridge or estimator makes no pass over their samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from numpy.typing import NDArray
from pydantic import TypeAdapter

from torchid import ranks
from torchid.commands.cache import Cache, Entry, content_key
from torchid.fitting.experiment import Experiment
from torchid.fitting.packed_parts import PackedPart, PartPacker, PartReader
from torchid.problem import RowBuilder, Samples, TriangularFactor
from torchid.problem.chunks import worker_count
from torchid.problem.compression import Part

_FORMAT = 3  # of entries
_PARTS = TypeAdapter(list[PackedPart])


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
            "surplus": [block.motion_noise is not None for block in blocks],
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
    """The document and the numbers of an entry."""
    packer = PartPacker()
    document = {
        "parts": packer.pack(parts),
        "of": [[sources.index(part.source), part.fold, part.block, part.unloaded] for part in parts],
        "supports": packer.supports,
    }
    return document, {"values": packer.values}


def _unpacked(entry: Entry, builder: RowBuilder, sources: Sequence[str]) -> list[Part]:
    """What was stored, of logs of these names; any exception where that is something else."""
    document, columns = entry.document, builder.width
    reader = PartReader(
        entry.arrays["values"], document["supports"], columns, len(builder.contacts), len(builder.extras)
    )
    parts = []
    for packed, (source, fold, block, unloaded) in zip(
        _PARTS.validate_python(document["parts"]), document["of"], strict=True
    ):
        part = reader.read(sources[source], packed, unloaded)
        factor = part.factor
        blocks, surplus = (
            {support: x.to(builder.device) for support, x in by.items()} for by in (factor.blocks, factor.surplus)
        )
        moved = TriangularFactor.from_blocks(columns, factor.rows, factor.independent_rows, blocks, surplus)
        parts.append(replace(part, factor=moved, fold=fold, block=block))
    if reader.numbers_left:
        raise ValueError("more numbers than are described")
    return parts
