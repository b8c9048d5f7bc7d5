"""Undo the compression of a chunk of a bag, as long as it does not fill the memory."""

from __future__ import annotations

import bz2
import io

import lz4.frame
import zstandard

from torchid.guards import Budget
from torchid.text import shown


def expanded(data: bytes, compression: str, budget: Budget) -> bytes:
    """The chunk as it was before compression by `compression`: bz2, lz4, zstd, or nothing for none.

    Raises:
        ValueError: another compression, or more bytes than the budget of the file has left.
    """
    limit = budget.most()
    if compression in ("", "none"):
        out = data
    elif compression == "bz2":
        out = bz2.BZ2Decompressor().decompress(data, limit + 1)
    elif compression == "lz4":
        out = lz4.frame.LZ4FrameDecompressor().decompress(data, limit + 1)
    elif compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=True) as stream:
            out = stream.read(limit + 1)
    else:
        raise ValueError(f"chunks compressed by '{shown(compression)}'")
    if len(out) > limit:
        raise ValueError(f"a chunk of {len(data)} bytes that stands for more than {limit}")
    budget.expand(len(out))
    return out
