"""From log files to samples of a robot: flags, pose of the base, filter, binding, slip.

A log that is too large to be worked on at once is cut into parts that overlap as far as the filter remembers. Each part
is prepared like any log in memory; its samples are kept on the disk, without those of the overlap.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid import distributed
from torchid.config.logs import LogsConfig, PreprocessingConfig, require_apart
from torchid.errors import ConfigError, LogError, about_file
from torchid.fitting.experiment import RobotSetup, S
from torchid.log_checks import drop_rejected
from torchid.log_checks.check import check
from torchid.log_checks.spikes import warn_of_steps
from torchid.logs import Log, read_log
from torchid.logs.blocks import GIGABYTE, LogBlocks, has_blocks, log_bytes, open_log_blocks
from torchid.logs.dry_friction import with_sign_filter, with_signs_of
from torchid.logs.flags import with_flags_by_force
from torchid.logs.gaps import Coverage
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.low_pass import LowPass
from torchid.logs.preprocess import (
    away_from_stamps,
    find_unloaded,
    lacks_derivatives,
    make_timeline,
    measured_coverage,
    move_to_timeline,
    near_contact_changes,
    unloaded_readings,
)
from torchid.logs.read import files_of_recordings_kept
from torchid.logs.segments import count_samples, long_segments, with_delayed_torques
from torchid.logs.signal_noise import signal_noise, warn_of_noisy_accelerations
from torchid.logs.spill import MappedPages, Spill
from torchid.logs.time_range import LogPart, split_range
from torchid.logs.timeline import JITTER, SPLINE_OVERLAP, Timeline
from torchid.parameters import Array
from torchid.problem import Samples, bind_log
from torchid.problem.base_pose import LogWithPose, base_pose_from_feet, warn_of_pose
from torchid.problem.contact_detection import with_detected_contacts
from torchid.problem.contact_slip import measure_slip, warn_of_slip
from torchid.problem.log_joints import with_loop_joints, without_welded_joints
from torchid.problem.motion import BaseMotion
from torchid.problem.samples import concatenate, oversampling
from torchid.problem.unloaded_sensors import zero_in_air
from torchid.robot import payload_parameters, with_payload
from torchid.sensing import SensorSet
from torchid.sensing.sensors import UP

_COPIES = 8  # a part takes some times the memory of its recorded arrays: derivatives, splines, bound tensors
_SHARED_MULTIPLE = 840  # samples of parts and overlaps: where every k-th is kept, k to 8, these are the same
_FEWEST = 5 * _SHARED_MULTIPLE  # samples of a part

_SETTLED_S = 1.0  # beyond the filter's reach, for flags and poses that follow from samples before [s]


class LogReader:
    """Reads, preprocesses and binds logs; each on its own, so that nothing is differentiated across a seam.

    Samples of a log that is worked on in parts are kept on the disk, as are those of logs from the one on that together
    with those before it takes more than the memory they may take.

    Attributes:
        setup: robot, contacts and settings.
        folder: on whose disk samples are kept, as long as they are used.
        excluded: how many samples of each log were left out because they are rejected, by path.
    """

    def __init__(self, setup: RobotSetup, folder: Path | None = None) -> None:
        """Nothing is read yet; without a `folder` it is the one that the output of the setup goes to, or a temporary.

        Raises:
            ConfigError: settings that leave the cutoff to the logs, where it has not been chosen.
        """
        if setup.config.preprocessing.cutoff_hz == "auto":
            raise ConfigError.at_field("preprocessing.cutoff_hz", "auto is not chosen yet", "a number [Hz] or null")
        self.setup = setup
        self.folder = _folder_beside(setup.config.output) if folder is None else folder
        self.excluded: dict[str, int] = {}
        self._held_gb = 0.0  # arrays of logs in memory

    def read(
        self, paths: Sequence[Path], required: SensorSet | None, on_read: Callable[[Path], None] | None = None
    ) -> list[Samples]:
        """The samples of log files.

        Args:
            paths: log files.
            required: sensors that must have been recorded.
            on_read: called after each file.

        Raises:
            LogError: a file that cannot be read, or does not fit the robot.
        """
        logs = list[Samples]()
        with files_of_recordings_kept():
            for path in paths:
                logs.append(self._read_one(path, required))
                if on_read is not None:
                    on_read(path)
        names = distributed.broadcast([log.source for log in logs], "names of the logs")  # they may lie elsewhere there
        added = [payload_of(self.setup, path) for path in paths]
        return [replace(log, source=name, payload=x) for log, name, x in zip(logs, names, added, strict=True)]

    def _read_one(self, path: Path, required: SensorSet | None) -> Samples:
        """The samples of a log, in memory or on the disk."""
        files = self.setup.config.logs
        limit_gb = self.setup.config.preprocessing.memory_gb
        size_gb = self._size_gb(path)
        self.excluded.pop(str(path), None)
        if size_gb > limit_gb and split_range(path).joins:
            reason = f"several files with {size_gb:.2g} GB of arrays do not fit into memory"
            needed = f"a preprocessing.memory_gb above {size_gb:.2g}"
            raise LogError(path, "file", reason, f"{needed}, or one file from torchid convert")
        has_parts = size_gb > limit_gb or has_blocks(path, None if files is None else files.columns)
        if size_gb > limit_gb / _COPIES and has_parts:
            samples = self._in_parts(path, required)
        else:
            samples = self.samples_of(self._recorded(path), path, required)
            together_gb = self._held_gb + size_gb
            if together_gb > limit_gb:
                samples = _on_disk(path, self.folder, [samples])
            else:
                self._held_gb = together_gb or samples.nbytes / GIGABYTE  # that of a bag is not known before
        if not len(samples):
            margin_s = self.setup.config.preprocessing.margin_s or 0.0
            reason = f"all samples are within {margin_s:g} s of a change of contact"
            accepted = "a smaller preprocessing.contact_margin_s"
            if self._checks_slip:
                reason = f"{reason}, or a contact slips"
                accepted = "a larger preprocessing.max_slip, or a smaller contact_margin_s"
            raise LogError(path, "contact_active", reason, accepted)
        return samples

    def _size_gb(self, path: Path) -> float:
        """What the arrays of a log take."""
        return memory_needed(path, self.setup.config.preprocessing.memory_gb / _COPIES)

    def _recorded(self, path: Path) -> Log:
        """A log as it is in its file."""
        settings = self.setup.config.preprocessing
        return recorded_log(path, self.setup.config.logs, settings, allow_gaps=settings.exclude_rejected)

    # ------------------------------------------------------------------------------------------------- logs in parts

    def _in_parts(self, path: Path, required: SensorSet | None) -> Samples:
        """The samples of a log of which a part is in memory at a time."""
        settings = self.setup.config.preprocessing
        files = self.setup.config.logs
        columns = None if files is None else files.columns
        with about_file(path), open_log_blocks(path, self.folder, columns, settings.needs_flags) as blocks:
            self._require_known_heading(blocks)
            most = int(settings.memory_gb * GIGABYTE / (_COPIES * blocks.row_bytes))
            starts = range(0, len(blocks), max(most // _SHARED_MULTIPLE * _SHARED_MULTIPLE, _FEWEST))
            pieces = (slice(start, min(start + starts.step, len(blocks))) for start in starts)
            return _on_disk(path, self.folder, (self._part(blocks, path, piece, required) for piece in pieces))

    def _part(self, blocks: LogBlocks, path: Path, piece: slice, required: SensorSet | None) -> Samples:
        """Some successive samples of a log, by those around that they depend on."""
        settings = self.setup.config.preprocessing
        time = blocks.time
        beyond = _overlap(time, settings.filter_hz)
        around = slice(max(piece.start - beyond, 0), min(piece.stop + beyond, len(time)))
        name = f"{path} (samples {around.start} to {around.stop - 1} of {len(time)}, counted from {around.start})"
        with about_file(path if around == slice(0, len(time)) else name):
            log = blocks.read(around, settings.exclude_rejected, settings.bridge_gaps_s)
        samples = self.samples_of(log, path, required)
        stamps = samples.time.numpy()
        slack = JITTER * float(np.median(np.diff(log.time)))  # however they round
        inside = stamps >= time[piece.start] - slack
        if piece.stop < len(time):
            inside &= stamps < time[piece.stop] - slack
        return samples[torch.from_numpy(np.flatnonzero(inside))]

    def _require_known_heading(self, blocks: LogBlocks) -> None:
        """Refuse a tilted floor on which the feet alone tell a heading, from the beginning of the whole log on."""
        settings = self.setup.config.preprocessing
        measured = "imu_frame" in blocks.names or any(name.startswith("base_quat") for name in blocks.row_shapes)
        by_feet = settings.base_motion is not None or (settings.detect_contacts is not None and not measured)
        if by_feet and any(contact.normal != UP for contact in self.setup.contacts):
            setting = "detect_contacts" if settings.base_motion is None else "base_motion: contacts"
            reason = f"unknown: {setting} on a tilted floor needs the whole log in memory"
            accepted = "the base's orientation or an IMU, a larger preprocessing.memory_gb, or shorter logs"
            raise LogError(blocks.source, "base_quat_xyzw", reason, accepted)

    # --------------------------------------------------------------------------------- the steps of a log in memory

    @property
    def _checks_slip(self) -> bool:
        return self.setup.config.preprocessing.max_slip is not None and bool(self.setup.contacts)

    def samples_of(self, recorded: Log, path: Path, required: SensorSet | None) -> Samples:
        """The samples of a log, or of a part of one, that are kept; there may be none."""
        setup = self.setup
        settings = self.setup.config.preprocessing
        loaded = setup_of_log(setup, path)
        acting = with_delayed_torques(without_welded_joints(recorded, loaded.robot), setup.config.actuators.known_delay)
        flagged, certain = apply_contact_settings(with_loop_joints(acting, loaded.robot), loaded)
        checked = None
        clean = flagged
        if settings.exclude_rejected:
            declared = replace(setup.declared, delay=0.0)  # the log has been read with it
            checked = check(flagged, loaded.robot, setup.contacts, settings.filter_hz, settings.derived, declared)
            clean = checked.repaired
        else:
            warn_of_steps(flagged)
        with about_file(recorded.source):
            samples, moved, is_derived = self._bound(clean, required)
        time = samples.time.numpy()
        kept = np.ones(len(time), dtype=bool)
        if flagged.contact_active is not None and self._checks_slip:
            from_feet = settings.base_motion is not None
            limits = settings.slip_limit, settings.filter_hz, from_feet
            slip = measure_slip(moved, samples, flagged, setup.robot, setup.contacts, *limits)
            warn_of_slip(slip, recorded.source)
            kept &= ~slip.slips.any(axis=1)
        if settings.margin_s is not None and settings.detect_contacts is None:
            kept &= ~near_contact_changes(flagged, time, settings.margin_s)
        if not certain.all():
            kept &= away_from_stamps(time, flagged.time[~certain], settings.margin_s or 0.0)
        if checked is not None:
            usable = drop_rejected(samples, checked, settings.filter_hz, is_derived)
            before = self.excluded.get(str(path), 0)
            self.excluded[str(path)] = before + len(samples) - len(usable)
            kept &= np.isin(time, usable.time.numpy())
        return samples if kept.all() else samples[torch.from_numpy(np.flatnonzero(kept))]

    def _bound(self, log: Log, required: SensorSet | None) -> tuple[Samples, Log, bool]:
        """A log filtered, differentiated and in the robot's order.

        Segments between which the base's pose is not known are worked on by themselves, with the coverage and the
        friction's sign of all.

        Returns:
            All samples, the last segment of the log that they are bound from, and whether samples depend on others.
        """
        setup = self.setup
        settings = self.setup.config.preprocessing
        if setup.contacts and log.contact_active is not None and fits_contact_offsets(setup):
            log = replace(log, contact_unloaded=unloaded_readings(log, find_unloaded(log.time, log.contact_active)))
        standing = None
        longest = log
        stated = setup.config.sensors.noise.motion
        if settings.base_motion is not None:
            standing = base_pose_from_feet(log, setup.robot, setup.contacts)
            log = standing.log
            longest = log.select(max(standing.segments, key=lambda segment: segment.stop - segment.start))
            stated = {}
        whole = self._timeline(log.time, lacks_derivatives(longest))
        noise = signal_noise(longest, whole, stated)
        coverage = dict[str, Coverage]()
        if whole is not None:
            whole = with_sign_filter(whole, longest, noise)
            coverage = measured_coverage(log, whole)
        segments = [(log, whole)]
        if standing is not None and whole is not None:
            segments = self._segments(standing, whole)
        samples = list[Samples]()
        bandwidths = list[float]()
        for segment, timeline in segments:
            moved = segment
            if timeline is not None:
                moved = move_to_timeline(segment, timeline, coverage)
                bandwidths += [] if timeline.bandwidth_hz is None else [timeline.bandwidth_hz]
                if len(segment) == len(longest):  # which stands for all
                    warn_of_noisy_accelerations(segment, moved, timeline, noise)
            if standing is None:
                moved = replace(moved, motion_noise=noise)
            samples.append(bind_log(moved, setup.robot, setup.contacts, required))
        bound = concatenate(samples)
        if not fits_contact_offsets(setup):
            bound = replace(bound, unloaded=None)
        rate = oversampling(bound.time.numpy(), min(bandwidths, default=None))
        return replace(bound, oversampling=rate), moved, whole is not None or noise.found

    def _timeline(self, time: FloatArray, differentiates: bool) -> Timeline | None:
        """Stamps of a log and of what becomes of it; None where nothing has to be done."""
        setup = self.setup
        settings = self.setup.config.preprocessing
        friction = setup.terms.sign_width, setup.terms.stribeck, setup.config.actuators.known["stiction"]
        return make_timeline(time, differentiates, settings.filter_hz, settings.sample_rate_hz, *friction)

    def _segments(self, standing: LogWithPose, whole: Timeline) -> list[tuple[Log, Timeline | None]]:
        """The segments of a log with a pose that are long enough, each with its timeline; warns of the others."""
        usable = long_segments(standing.log.time, standing.segments, whole)
        warn_of_pose(standing, count_samples(standing.segments) - count_samples(usable))
        segments = list[tuple[Log, Timeline | None]]()
        for chosen in usable:
            segment = standing.log.select(chosen)
            timeline = self._timeline(segment.time, True)
            segments.append((segment, None if timeline is None else with_signs_of(timeline, whole)))
        return segments


def _overlap(time: FloatArray, cutoff_hz: float | None) -> int:
    """Samples on either side of a part that it depends on, of a log with stamps (N,) [s] that is filtered so."""
    step = float(np.median(np.diff(time)))
    samples = SPLINE_OVERLAP + math.ceil(_SETTLED_S / step)
    if cutoff_hz is not None and cutoff_hz < 0.5 / step:
        low_pass = LowPass.butterworth(cutoff_hz, step)
        samples += 2 * (low_pass.settling + low_pass.padding)  # directions are filtered twice
    return math.ceil(samples / _SHARED_MULTIPLE) * _SHARED_MULTIPLE


def _on_disk(path: Path, folder: Path, parts: Iterable[Samples]) -> Samples:
    """Successive samples of a log as one, in temporary files in a folder; what is no tensor is that of the first."""
    spills: defaultdict[tuple[str, bool], Spill] = defaultdict(partial(Spill, path, folder))
    first: Samples | None = None
    for samples in parts:
        first = samples[:0] if first is None else first
        for part, is_base in ((samples, False), (samples.base, True)):
            for name, x in vars(part).items():
                if isinstance(x, Tensor):
                    spills[name, is_base].append(x.numpy())
    if first is None:
        raise ValueError("no samples")
    arrays = {key: spill.array() for key, spill in spills.items()}
    of_log: dict[str, Any] = {name: torch.from_numpy(x) for (name, is_base), x in arrays.items() if not is_base}
    of_base = {name: torch.from_numpy(x) for (name, is_base), x in arrays.items() if is_base}
    pages = MappedPages(arrays.values())
    return replace(first, source=str(path), folder=folder, pages=pages, base=BaseMotion(**of_base), **of_log)


def apply_contact_settings(log: Log, setup: RobotSetup) -> tuple[Log, BoolArray]:
    """A log with the flags and zeros of contacts that the settings want, and where the flags (N,) are certain."""
    flagged, certain = _with_flags(log, setup)
    if not setup.config.preprocessing.zero_in_air:
        return flagged, certain
    zeroed = zero_in_air(flagged, setup.contacts)
    if setup.config.preprocessing.contact_threshold is None:
        return zeroed, certain
    return _with_flags(zeroed, setup)


def _with_flags(log: Log, setup: RobotSetup) -> tuple[Log, BoolArray]:
    """A log with contact flags as recorded, from joint torques or from forces, and where they are certain."""
    settings = setup.config.preprocessing
    if settings.detect_contacts is not None:
        possible = settings.takes_possible_contacts
        width = setup.terms.sign_width
        return with_detected_contacts(log, setup.robot, setup.contacts, settings.detect_contacts, possible, width)
    if settings.contact_threshold is not None:
        return with_flags_by_force(log, settings.contact_threshold)
    return log, np.ones(len(log), dtype=bool)


def check_read(logs: Mapping[str, Sequence[Samples]]) -> None:
    """Check that no sample of a part is used twice, and that some samples remain for the fit.

    Args:
        logs: by their key in `logs`.

    Raises:
        ConfigError: as `require_apart`.
        LogError: torques of joints at rest count as unmeasured, and all joints of a bolted robot rest.

    Warns:
        TorchidWarning: as `require_apart`.
    """
    train = logs.get("train", ())
    bolted = [log for log in train if log.base.specific_force is None and log.resting is not None]
    if train and len(bolted) == len(train) and all(bool(x.resting.all()) for x in bolted if x.resting is not None):
        reason = "true, but all joints rest in all samples, or are too close to rest for the filter"
        raise LogError(train[0].source, "actuators.stiction", reason, "logs with moving joints, or false")
    parts = {key: [split_range(log.source) for log in of_key] for key, of_key in logs.items()}
    spans = {split_range(log.source): log.time[[0, -1]].tolist() for of_key in logs.values() for log in of_key}

    def share(part: LogPart, other: LogPart) -> bool:
        start, stop = spans[part]
        (of_other, until) = spans[other]
        return part.shares_samples(other) is None and start <= until and of_other <= stop

    require_apart(parts, share)


def fits_contact_offsets(setup: RobotSetup) -> bool:
    """Whether offsets of contact sensors are fitted, the only use of their readings in the air."""
    return any(channel.startswith("contact") for channel in setup.terms.offsets)


def recorded_log(path: Path, files: LogsConfig | None, settings: PreprocessingConfig, allow_gaps: bool = True) -> Log:
    """A log as it is in its file, by an experiment's maps; `allow_gaps`: with those that are too long to be bridged."""
    return read_log(
        path,
        None if files is None else files.topics,
        allow_gaps=allow_gaps,
        columns=None if files is None else files.columns,
        bridge_gaps_s=settings.bridge_gaps_s,
        needs_flags=settings.needs_flags,
    )


def memory_needed(path: Path, memory_gb: float, held: float = 0.0) -> float:
    """What the arrays of a log take together with those that are held [GB]; at most that, where that is in `memory_gb`.

    A bag counts as nothing: its size is known when it has been read.

    Raises:
        LogError: the file cannot be read.
    """
    return held + log_bytes(path, GIGABYTE * (memory_gb - held)) / GIGABYTE


def _folder_beside(output: Path | None) -> Path:
    """The folder that a run goes to, or the nearest above it that exists already; that of the system without a run."""
    if output is None:
        return Path(gettempdir())
    return next((folder for folder in output.absolute().parents if folder.is_dir()), Path.cwd())


def payload_of(setup: RobotSetup, path: str | Path) -> Array | None:
    """What the robot carried in a log, (12 L,), as `Samples.payload` has it; None for nothing."""
    payloads = () if setup.config.logs is None else setup.config.logs.payloads_of(path)
    return payload_parameters(setup.robot, payloads) if payloads else None


def setup_of_log(setup: S, path: str | Path) -> S:
    """The setup with the nominal robot as it was in a log, for whatever compares recordings with it."""
    return replace(setup, robot=with_payload(setup.robot, payload_of(setup, path)))
