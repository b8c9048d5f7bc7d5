"""The messages of one topic as a time series."""

from __future__ import annotations

import warnings
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, TorchidWarning, UnknownNameError
from torchid.guards import MAX_ARRAYS
from torchid.logs.fields import FloatArray
from torchid.logs.ros.messages import Decoder, JointStates

Stamps = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Series:
    """What one topic says: stamps (N,) [ns], strictly increasing, and the fields of a log (N, ...).

    `stamped`: whether the stamps are the messages' own, and not the times of receipt.
    """

    topic: str
    stamps: Stamps
    fields: dict[str, FloatArray]
    stamped: bool = True


class Rows:
    """Messages of a topic as they arrive."""

    def __init__(self, source: str, topic: str, decoder: Decoder) -> None:
        """Start without any."""
        self.topic, self._source, self._decoder = topic, source, decoder
        self._stamps, self._received, self._values = array("q"), array("q"), array("d")

    def add(self, message: Any, received: int) -> None:
        """Take a message in that was received at a time [ns]."""
        row = self._decoder.row(message)
        if row is None:
            return
        stamp = message.header.stamp if hasattr(message, "header") else None
        self._stamps.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        self._received.append(received)
        self._values.frombytes(np.asarray(row, dtype=np.float64).tobytes())
        if 8 * len(self._values) > MAX_ARRAYS:
            raise LogError(self._source, self.topic, "more messages than fit", f"{MAX_ARRAYS} bytes")

    def series(self) -> Series:
        """All messages in the order of their stamps, each once.

        Raises:
            LogError: there are none, or some have the same stamp and say different things.
            UnknownNameError: there are none of the joints asked for.

        Warns:
            TorchidWarning: messages come twice.
        """
        if not self._stamps and isinstance(self._decoder, JointStates) and self._decoder.others:
            place, (name, *_) = "logs.topics.joint_states.joints", self._decoder.names
            raise UnknownNameError(self._source, place, name, self._decoder.others)
        if not self._stamps:
            raise LogError(self._source, self.topic, "no messages", "at least one")
        stamps: Stamps = np.array(self._stamps, dtype=np.int64)
        rows: FloatArray = np.array(self._values, dtype=np.float64).reshape(len(stamps), -1)
        stamped = bool(stamps.any())
        if not stamped:
            stamps = np.array(self._received, dtype=np.int64)
        if np.any(np.diff(stamps) < 0):
            order = np.argsort(stamps, kind="stable")
            stamps, rows = stamps[order], rows[order]
        again = np.flatnonzero(np.diff(stamps) == 0) + 1
        if len(again):
            differ = np.any(rows[again].view(np.int64) != rows[again - 1].view(np.int64), axis=1)
            if differ.any():
                at = stamps[again[np.argmax(differ)]] / 1e9
                found = f"messages of different content with one stamp, {at:.9f} s"
                raise LogError(self._source, self.topic, found, "every stamp once")
            message = f"{self._source}: {self.topic}: {len(again)} messages come twice; each counts once"
            warnings.warn(message, TorchidWarning, stacklevel=4)
            stamps, rows = np.delete(stamps, again), np.delete(rows, again, axis=0)
        return Series(self.topic, stamps, self._decoder.fields(rows), stamped)
