"""Reading logs through a cache of samples, whose missing entries processes of one run write together."""

from __future__ import annotations

import secrets
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchid import distributed
from torchid.checksums import FilePart, checksum_of_parts, file_parts, file_states, part_checksum
from torchid.errors import TorchidWarning, warn
from torchid.fitting.experiment import RobotSetup
from torchid.fitting.noise import recorded_sensors
from torchid.logs.blocks import GIGABYTE, log_bytes
from torchid.logs.containers import LogKind, existing_log_kind, log_files
from torchid.logs.lazy_arrays import MappedPages
from torchid.logs.low_pass import import_signal
from torchid.logs.table_files import is_text_table
from torchid.logs.time_range import split_range
from torchid.problem import Samples
from torchid.reading.cache import FOLDER, TOKEN, Cache, Files, content_key, missing_folders, remove_empty
from torchid.reading.cache_entries import ReadLog, RecordedWarning, content_of_setup, samples_entry, samples_of_entry
from torchid.reading.log_reader import LogReader, fits_contact_offsets, payload_of
from torchid.reading.shared_log import on_one_machine, read_together
from torchid.sensing import SensorSet
from torchid.sensing.sensors import recorded_components


def open_reader(setup: RobotSetup) -> LogReader:
    """What reads logs, through the cache beside the output if there is to be one. All processes call this together."""
    cache = open_cache(setup)
    return LogReader(setup) if cache is None else CachedReader(setup, cache)


def open_cache(setup: RobotSetup) -> Cache | None:
    """The cache beside the output of an experiment; None without any, or where processes have no common folder.

    All processes that share the work call this together.
    """
    size, output = setup.config.preprocessing.cache_gb, setup.config.output
    if not size or output is None:
        return None
    cache = Cache(output.absolute().parent / FOLDER, size)
    if distributed.world_size() > 1 and not _is_common(cache.folder):
        return None
    if distributed.is_first():
        cache.tidy()
    return cache


def _is_common(folder: Path) -> bool:
    """Whether all processes find in a folder what the first one has just put there."""
    name, missing = "", missing_folders(folder)
    if distributed.is_first():
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / (token := f"{TOKEN}{secrets.token_hex(8)}")).touch()
            name = token
    name = distributed.broadcast(name, "a file for all processes")
    found = all(distributed.all_gather(bool(name) and (folder / name).is_file(), "a common folder"))
    if name and distributed.is_first():
        with suppress(OSError):
            (folder / name).unlink()
        remove_empty(missing)
    return found


@dataclass(frozen=True)
class _Content:
    """Checksum of a log, and its files with their states when it was worked out."""

    checksum: str
    files: list[Path]
    states: list[list[int]]


@dataclass(frozen=True)
class _LogToRead:
    """A log that will be read, the name of its samples, what it takes with others if that is too much, its bytes.

    `in_place`: it is read in blocks, which lie in its file as they are: neither a table nor compressed.
    """

    path: Path
    key: str
    together: float | None
    size: int
    in_place: bool


class CachedReader(LogReader):
    """Takes the samples of logs from a cache, and reads and stores those that are not there.

    Samples of the cache are mapped to its files: all processes of a machine have them in memory once.

    Attributes:
        keys: names of the samples of each log by its path, which stand for all that these depend on.
        reused: logs that an earlier run has read.
    """

    def __init__(self, setup: RobotSetup, cache: Cache) -> None:
        super().__init__(setup)
        self.cache, self.keys, self.reused = cache, dict[str, str](), set[str]()
        self._new = set[str]()  # keys that were not there when this run began
        self._contents: dict[Path, _Content] = {}
        self._setup_content = content_of_setup(setup)
        self._mapped: list[MappedPages] = []

    def release(self) -> None:
        """As `LogReader.release`."""
        for one in self._mapped:
            one.release()

    def read(
        self, paths: Sequence[Path], required: SensorSet | None, on_read: Callable[[Path], None] | None = None
    ) -> list[Samples]:
        """As `LogReader.read`; of processes that share the work, each reads some of the logs for all."""
        if distributed.world_size() > 1:
            self._fill_together(paths, required)
        logs = super().read(paths, required, on_read)
        if distributed.is_first():
            self.cache.write_index()
        return logs

    def _together(self, path: Path) -> float:
        room = self.setup.config.preprocessing.memory_gb - self._held
        content, part = self._content(path), split_range(path)
        file = part.file
        is_text = any(is_text_table(one.path) for one in part.files)
        bound = room if is_text else 0.0  # for others, `log_bytes` does not depend on it
        size = None if content is None else self.cache.array_bytes(file, content.checksum, bound)
        if size is None:
            size = log_bytes(path, GIGABYTE * room)
            if content is not None:
                self.cache.note_array_bytes(file, content.checksum, bound, size)
        return self._held + size / GIGABYTE

    def _samples(self, path: Path, required: SensorSet | None, together: float | None) -> Samples:
        key = self._key(path, required, together)
        if key is None:
            return super()._samples(path, required, together)
        if not self.cache.has(key):
            self._new.add(key)
            if (
                distributed.world_size() == 1
                and (one := self._log_to_read(path, key, together, self._together(path))).in_place
            ):
                self._store_together([one], 0, required)
        found = self._load(key, path, required, together)
        if found is None:
            warned: list[RecordedWarning] = []
            try:
                found = self._read(path, required, together, warned)
            finally:
                _reissue(warned)
            if distributed.world_size() == 1 and self._store(key, path, found):
                found = self._load(key, path, required, together) or found
        else:
            _reissue(found.warned)
            if key not in self._new:
                self.reused.add(str(path))
        self.keys[str(path)] = key
        if found.excluded is not None:
            self.excluded[str(path)] = found.excluded
        return found.samples

    def _read(
        self, path: Path, required: SensorSet | None, together: float | None, warned: list[RecordedWarning]
    ) -> ReadLog:
        """A log as it is read without a cache; warnings go to a list."""
        with _collecting_warnings(warned):
            samples = super()._samples(path, required, together)
        return ReadLog(samples, self.excluded.get(str(path)), warned)

    # ---------------------------------------------------------------------------------------------- keys and entries

    def _content(self, path: Path) -> _Content | None:
        """What is in a log; None where it cannot be read, which reading then says."""
        if path not in self._contents:
            existing_log_kind(path)
            files = log_files(path)
            try:
                states = file_states(files)
                checksum = self.cache.checksum(split_range(path).file, files, self._import_filters)
                self._contents[path] = _Content(checksum, files, states)
            except OSError:
                return None
        return self._contents[path]

    def _import_filters(self) -> None:
        """Import what reads a log that is not in the cache, as one of unknown content hardly is."""
        if self.setup.config.preprocessing.filter_hz is not None:
            import_signal()

    def _key(self, path: Path, required: SensorSet | None, together: float | None) -> str | None:
        """The name of the samples of a log, None if it cannot be read.

        Reading block by block rounds otherwise than reading a log as a whole, and with the size of the blocks. Where
        samples are dropped, what was required of them before does not follow from what is left.
        """
        content = self._content(path)
        if content is None:
            return None
        settings = self.setup.config.preprocessing
        drops = settings.exclude_rejected or settings.margin_s is not None or settings.max_slip is not None
        masks = None if required is None or not drops else [required.torque.tolist(), required.wrench.tolist()]
        blocks = None if together is None else settings.memory_gb
        part = split_range(path)
        log = [content.checksum, part.kind, None if part.range is None else part.range.text]
        added = payload_of(self.setup, path)
        carried = [] if added is None else [added.tolist()]
        return content_key([self._setup_content, log, blocks, masks, *carried])

    def _store(self, key: str, path: Path, read: ReadLog) -> bool:
        """Whether an entry is there now; none is written of a log that has changed since its key was made."""
        content = self._content(path)
        if content is None or file_states(content.files) != content.states:
            return False
        return self.cache.save(key, *samples_entry(read))

    def _load(self, key: str, path: Path, required: SensorSet | None, together: float | None) -> ReadLog | None:
        """Samples from the cache; None if they are not there, or lack what is required, which reading then says."""
        entry = self.cache.load(key)
        if entry is None:
            return None
        try:
            found = samples_of_entry(entry, str(path), None if together is None else self.folder)
        except Exception as error:  # noqa: B902 - whatever another program has put there
            self.cache.drop(key, str(error))
            return None
        if found.samples.pages is not None:
            self._mapped.append(found.samples.pages)
        return found if required is None or self._has(found, required) else None

    def _has(self, found: ReadLog, required: SensorSet) -> bool:
        """Whether every value of the required sensors was recorded."""
        contacts = self.setup.contacts
        recorded = recorded_sensors(self.setup.robot, contacts, found.samples.pieces())
        needed = recorded_components(contacts, required, found.samples.wrench_in_world)
        return not (required.torque & ~recorded.torque).any() and not (needed & ~recorded.wrench).any()

    # ------------------------------------------------------------------------------------------ several processes

    def _fill_together(self, paths: Sequence[Path], required: SensorSet | None) -> None:
        """Store the samples of logs that the cache lacks, each by one of the processes; a log that fails is left.

        All processes then find the same entries, and read what is not there themselves: what cannot be read fails in
        all of them, as without a cache.
        """
        self._sum_up_together(paths)
        to_read = self._logs_to_read(paths, required)
        self.cache.keep([one.key for one in to_read])
        missing = {one.key: number for number, one in enumerate(to_read) if not self.cache.has(one.key)}
        self._new.update(missing)
        whole, in_pieces = {number: to_read[number].size for number in missing.values()}, list[int]()
        if on_one_machine():
            in_pieces = [
                x for x in whole if to_read[x].in_place and whole[x] * distributed.world_size() > sum(whole.values())
            ]
        in_pieces = distributed.broadcast(in_pieces, "logs to read in pieces")
        for number in in_pieces:
            self._store_together(to_read, number, required)
        own = _shares({number: size for number, size in whole.items() if number not in in_pieces})
        shares = distributed.broadcast(own, "logs to read")
        for number in shares[distributed.rank()]:
            try:
                one = to_read[number]
                self._store(one.key, one.path, self._read(one.path, required, one.together, []))
            except Exception:  # noqa: B902 - all processes meet it when they read the log
                break
        distributed.all_gather(None, "logs read")

    def _store_together(self, to_read: Sequence[_LogToRead], number: int, required: SensorSet | None) -> None:
        """Store the samples of a log block by block, of which each process reads some; or not, if one of them fails."""

        def fill(folder: str) -> tuple[dict[str, Any], Files] | None:
            if not all(distributed.all_gather(number < len(to_read), "logs to read together")):
                return None
            one = to_read[number]
            log = self._large_log(one.path, required, None if one.together is None else self.folder)
            return read_together(log, fits_contact_offsets(self.setup), Path(folder), self.cache.limit)

        def fill_for_all(folder: Path) -> tuple[dict[str, Any], Files] | None:
            begun.append(distributed.broadcast(str(folder), "a folder for a log"))
            written, content = fill(str(folder)), self._contents[to_read[number].path]
            return written if file_states(content.files) == content.states else None

        begun: list[str] = []
        if distributed.is_first():
            self.cache.save_files(to_read[number].key, to_read[number].size, fill_for_all)
        folder = "" if begun else distributed.broadcast("", "a folder for a log")
        if folder:
            fill(folder)

    def _sum_up_together(self, paths: Sequence[Path]) -> None:
        """Work out checksums of logs, each process of some parts of their files, if all see the same files."""
        seen = [_states_of_log(path) for path in paths]
        if any(other != seen for other in distributed.all_gather(seen, "states of logs")):
            return
        there = [(split_range(path).file, path, states) for path, states in zip(paths, seen, strict=True) if states]
        known = [bool(self.cache.known_checksum(log, states)) for log, _, states in there]
        new = [
            one
            for one, is_known in zip(there, distributed.broadcast(known, "known checksums"), strict=True)
            if not is_known
        ]
        parts = [(log, part) for log in dict.fromkeys(log for log, *_ in new) for part in file_parts(log_files(log))]
        sums = distributed.share_out(parts, _part_checksum, "checksums of logs", [part.size for _, part in parts])
        for log, path, states in new:
            of_log = [found for (other, _), found in zip(parts, sums, strict=True) if other == log]
            if all(of_log):
                self._contents[path] = content = _Content(checksum_of_parts(of_log), log_files(path), states)
                self.cache.note_checksum(log, content.files, states, content.checksum)

    def _logs_to_read(self, paths: Sequence[Path], required: SensorSet | None) -> list[_LogToRead]:
        """What will be read, up to the first log that cannot be; bags that are not in the cache count as nothing."""
        to_read, held, limit = [], self._held, self.setup.config.preprocessing.memory_gb
        try:
            for path in paths:
                together = self._together(path)
                large = together > limit and existing_log_kind(path) is not LogKind.BAG
                key = self._key(path, required, together if large else None)
                if key is None:
                    break
                to_read.append(self._log_to_read(path, key, together if large else None, together))
                self._held = self._held if large else together
        except Exception:  # noqa: B902 - raised again when the log is read
            return to_read
        finally:
            self._held = held
        return to_read

    def _log_to_read(self, path: Path, key: str, too_much: float | None, together: float) -> _LogToRead:
        size = sum(state[0] for state in self._contents[path].states)
        gigabytes = together - self._held
        in_place = existing_log_kind(path) is LogKind.ARRAYS and size >= GIGABYTE * gigabytes
        return _LogToRead(path, key, too_much, size, in_place and self._takes_blocks(path, gigabytes))


def _states_of_log(path: Path) -> list[list[int]]:
    """The states of the files of a log; none where it cannot be read, which reading then says."""
    try:
        existing_log_kind(path)
        return file_states(log_files(path))
    except Exception:  # noqa: B902 - as above
        return []


def _part_checksum(part: tuple[Path, FilePart]) -> str:
    """Checksum of a part of a log; none where it cannot be read."""
    with suppress(OSError):
        return part_checksum(part[1])
    return ""


def _shares(sizes: Mapping[int, int]) -> list[list[int]]:
    """Numbers of logs for each process, from their sizes: the largest first, each to whoever has least so far."""
    shares: list[list[int]] = [[] for _ in range(distributed.world_size())]
    taken = [0] * len(shares)
    for number in sorted(sizes, key=lambda number: (-sizes[number], number)):
        least = taken.index(min(taken))
        shares[least].append(number)
        taken[least] += sizes[number]
    return [sorted(share) for share in shares]


@contextmanager
def _collecting_warnings(warned: list[RecordedWarning]) -> Iterator[None]:
    """Gather all warnings instead of giving them."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")  # which of them are shown is decided where they are given
        try:
            yield
        finally:
            warned += [(one.category, str(one.message)) for one in caught]


def _reissue(warned: Iterable[RecordedWarning]) -> None:
    for category, message in warned:
        if issubclass(category, TorchidWarning):
            warn(message, category)
        else:
            warnings.warn(message, category, stacklevel=2)
