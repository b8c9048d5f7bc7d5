"""Contact sensors of a log that is read block by block: flags by what they read, and zeros in the air."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs import Log
from torchid.logs.blocks import LogBlocks
from torchid.logs.flags import ContactThreshold, MeasuredForces, flags_by_force
from torchid.logs.lazy_arrays import Computed
from torchid.logs.log import CONTACT_READINGS, FLAGS, FORCE_NORMAL, WRENCHES, BoolArray, FloatArray
from torchid.logs.preprocess import find_unloaded, unloaded_readings
from torchid.logs.spill import growing_array
from torchid.problem.derived_blocks import Pieces, contact_names
from torchid.problem.unloaded_sensors import offsets_in_the_air
from torchid.sensing import Contact


def contacts_alone(blocks: LogBlocks, pieces: Pieces) -> Log:
    """The log with nothing but the contacts' flags, if it has any, which takes a pass over these."""
    active = None
    if FLAGS in blocks.fields:
        flags = [blocks.read(piece, only=(FLAGS,)).contact_active for piece in pieces(len(blocks))]
        active = np.concatenate([x for x in flags if x is not None])
    nothing, names = np.empty((len(blocks), 0)), contact_names(blocks)
    return Log(blocks.source, blocks.time, (), nothing, contact_names=names, contact_active=active)


def flag_by_force_in_blocks(
    blocks: LogBlocks, settings: ContactThreshold, pieces: Pieces, folder: Path | None
) -> tuple[LogBlocks, BoolArray]:
    """As `with_flags_by_force`; two passes over the readings.

    Args:
        blocks: the log.
        settings: thresholds.
        pieces: in which it is read.
        folder: with room for the forces; None: in memory.

    Raises:
        LogError: as `with_flags_by_force`.
    """
    measured = MeasuredForces.of(blocks.source, (log for _, log in _readings(blocks, pieces)))
    forces = growing_array(blocks.source, folder, len(blocks))
    for _, log in _readings(blocks, pieces):
        forces.append(measured.sizes(log))
    active, certain = flags_by_force(contacts_alone(blocks, pieces), measured, forces.array(), settings)
    return blocks.replaced({FLAGS: active}), certain


def zero_in_blocks(blocks: LogBlocks, contacts: Sequence[Contact], pieces: Pieces) -> LogBlocks:
    """As `zero_in_air`, with moments about the world's origin; a pass over the flags, and one over the readings.

    Raises:
        LogError: as `zero_in_air`.

    Warns:
        TorchidWarning: likewise.
    """
    flags = contacts_alone(blocks, pieces)
    active = flags.contact_active
    in_the_air = None if active is None else find_unloaded(flags.time, active)

    def parts() -> Iterator[tuple[Log, FloatArray | None]]:
        for piece, log in _readings(blocks, pieces):
            yield log, None if in_the_air is None else unloaded_readings(log, in_the_air[piece])

    _, first = next(_readings(blocks, pieces))
    offsets = offsets_in_the_air(first, contacts, parts())

    def without(name: str, offset: FloatArray) -> Computed:
        array = blocks.fields[name]

        def rows_of(rows: slice) -> NDArray[Any]:
            return np.asarray(np.asarray(array[rows], dtype=np.float64) - offset)

        return Computed(array.shape, np.dtype(float), rows_of)

    channels = {FORCE_NORMAL: offsets[:, 6], **dict.fromkeys(WRENCHES, offsets[:, :6])}
    return blocks.replaced({name: without(name, x) for name, x in channels.items() if name in blocks.fields})


def _readings(blocks: LogBlocks, pieces: Pieces) -> Iterator[tuple[slice, Log]]:
    """Readings of contacts and flags, part by part."""
    for piece in pieces(len(blocks)):
        yield piece, blocks.read(piece, only=(*CONTACT_READINGS, FLAGS))
