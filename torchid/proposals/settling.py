"""Frames of velocities of a log in several files, as the numbers of each file say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy

from torchid.proposals.base import settle_velocities
from torchid.proposals.column_groups import MapProposal
from torchid.proposals.file_samples import FileSample
from torchid.proposals.numbers import UnitProposer


def settle_in_files(proposal: MapProposal, files: Sequence[FileSample], factors: Mapping[str, float]) -> None:
    """Give velocities of a base the frame that they are in by its pose in the same file, which has the same stamps.

    Args:
        proposal: changed in place.
        files: columns of each of several files that are one log.
        factors: of units that columns state, by key.
    """
    every = dict.fromkeys(name for sample in files for name in sample)
    for sample in files:
        columns = deepcopy(proposal.columns)
        others = [entry for entry in columns.get("other_times", ()) if entry["column"] in sample]
        columns |= {"time": others[0]} if others else {}
        units = UnitProposer({**every, **sample}, columns, {}, factors)
        if (seconds := units.seconds()) is not None:
            settle_velocities(proposal, units.values, seconds)
