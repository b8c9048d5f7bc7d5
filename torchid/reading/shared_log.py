"""One large log that processes of a machine read together: each some of its blocks, into files that all of them map."""

from __future__ import annotations

import errno
import io
import platform
import uuid
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from torchid import distributed
from torchid.checksums import file_checksum
from torchid.parallel import can_fork, share_between_forks, thread_count
from torchid.problem import Samples
from torchid.reading.cache import Files, written_file
from torchid.reading.cache_entries import ReadLog, RecordedWarning, named_tensors, samples_entry
from torchid.reading.large_log import LargeLog


def on_one_machine() -> bool:
    """Whether all processes can write to parts of one file; over a network they would overwrite each other's pages."""
    machine = platform.node(), uuid.getnode()
    return all(other == machine for other in distributed.all_gather(machine, "names of machines"))


@dataclass(frozen=True)
class _Share:
    """What a process reports of its blocks.

    `like`: samples without any, for whatever is no tensor, and the shapes of these; None if it had no block.
    `warned`: the first `common` of these warnings are about the log as a whole. `failed`: it could not go on.
    """

    like: Samples | None
    warned: Sequence[RecordedWarning]
    common: int
    failed: bool


def read_together(log: LargeLog, with_unloaded: bool, folder: Path, most: float) -> tuple[dict[str, Any], Files] | None:
    """Fill the files of an entry with the samples of a log; its document and its files.

    All processes that share the work call this together; one alone makes forks, which wait for no lock of Python's as
    threads do. Blocks do not depend on each other, so that the samples are those of one process to the last bit.

    Args:
        log: the log.
        with_unloaded: with readings of contact sensors in the air.
        folder: where the files go, the same for all.
        most: bytes that they may take.

    Returns:
        None in all processes but the first; there, too, if one has failed: who reads the log alone meets the reason.
    """
    forked = can_fork() and distributed.world_size() == 1 and log.folder is None
    count = thread_count() if forked else 1

    def fill(number: int) -> _Share:
        own = partial(distributed.share_of, number=number, count=count) if forked else distributed.own_share
        return _fill(log, with_unloaded, _Rows(folder, most), own, 0 if forked else None)

    own_shares = share_between_forks(range(count), fill, count)
    shares = [share for of_process in distributed.all_gather(own_shares, "blocks of a log") for share in of_process]
    likes = [one.like for one in shares if one.like is not None]
    if any(one.failed for one in shares) or not likes:
        return None
    names = list(named_tensors(likes[0]))
    paths = [folder / f"{name}.npy" for name in names]
    sizes = distributed.broadcast(
        [path.stat().st_size if distributed.is_first() else 0 for path in paths], "sizes of files"
    )
    if forked:
        sums = share_between_forks(paths, _checksum, count)
    else:
        sums = distributed.share_out(paths, _checksum, "checksums of files", sizes)
    if not all(sums) or not distributed.is_first():  # the first one moves the files to their place
        return None
    warned = [*shares[0].warned, *(x for one in shares[1:] for x in one.warned[one.common :])]
    document, _ = samples_entry(ReadLog(likes[0], None, warned))
    document["axes"] = {name: list(range(x.ndim)) for name, x in named_tensors(likes[0]).items()}
    files = {name: written_file(path, found) for name, path, found in zip(names, paths, sums, strict=True)}
    return document, files


def _fill(
    log: LargeLog, with_unloaded: bool, rows: _Rows, share: Callable[[Sequence[int]], slice], threads: int | None
) -> _Share:
    """Write the share of a log that a function chooses, in so many threads."""
    common, failed = 0, False

    def own(sizes: Sequence[int]) -> slice:
        nonlocal common
        common = len(caught)
        return share(sizes)

    with closing(rows), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            log.each_block(rows.add, with_unloaded, own, threads)
        except Exception:  # noqa: B902 - all processes meet it, and say it, when they read the log
            failed = True
    warned = [(one.category, str(one.message)) for one in caught]
    return _Share(rows.like, warned, common, failed)


def _checksum(path: Path) -> str:
    try:
        return file_checksum(path)
    except OSError:
        return ""


class _Rows:
    """Files of the tensors of a log's samples, into which this process writes some rows.

    Attributes:
        like: as `_Share` has it.
    """

    def __init__(self, folder: Path, most: float) -> None:
        """No file is opened yet; together they may have so many bytes."""
        self._folder, self._room = folder, most
        self._files: dict[str, tuple[BinaryIO, int]] = {}
        self.like: Samples | None = None

    def close(self) -> None:
        for file, _ in self._files.values():
            file.close()

    def add(self, samples: Samples, first: int, total: int) -> None:
        """Write samples from a number on, of so many in all. Raises OSError: there is no room."""
        for name, x in named_tensors(samples).items():
            rows = np.ascontiguousarray(x.numpy())
            if name not in self._files:
                self._files[name] = self._open(name, rows, total)
            file, start = self._files[name]
            file.seek(start + first * rows[:1].nbytes)
            rest = memoryview(rows.reshape(-1).view(np.uint8).data)
            while rest:
                rest = rest[file.write(rest) :]
        self.like = samples[torch.arange(0)]  # with no memory that would be sent along

    def _open(self, name: str, rows: np.ndarray[Any, Any], total: int) -> tuple[BinaryIO, int]:
        """The file of a tensor, as large as it will be, and where its rows begin; all processes make the same."""
        header, shape = io.BytesIO(), (total, *rows.shape[1:])
        described = np.lib.format.header_data_from_array_1_0(rows) | {"fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, described)
        size = header.tell() + int(np.prod(shape)) * rows.dtype.itemsize
        self._room -= size
        if self._room < 0:
            raise OSError(errno.EFBIG, "more than a cache may take")
        path = self._folder / f"{name}.npy"
        path.touch()
        file = path.open("r+b", buffering=0)  # noqa: SIM115 - see `close`
        file.truncate(size)
        file.write(header.getvalue())
        return file, header.tell()
