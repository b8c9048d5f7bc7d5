"""Logs on their way from files to a robot's samples, block by block where they are larger than memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import gettempdir

import numpy as np

from torchid import distributed
from torchid.config.logs import require_apart
from torchid.errors import ConfigError, LogError
from torchid.fitting.experiment import RobotSetup, S
from torchid.log_checks import drop_rejected
from torchid.log_checks.check import check
from torchid.log_checks.spikes import warn_of_steps
from torchid.logs import Log, read_log
from torchid.logs.blocks import GIGABYTE, has_blocks, log_bytes
from torchid.logs.containers import LogKind, existing_log_kind
from torchid.logs.flags import with_flags_by_force
from torchid.logs.log import BoolArray
from torchid.logs.read import files_of_recordings_kept
from torchid.logs.segments import with_delayed_torques
from torchid.logs.time_range import LogPart, split_range
from torchid.parameters import Array
from torchid.problem import Samples
from torchid.problem.contact_detection import with_detected_contacts
from torchid.problem.log_joints import with_loop_joints, without_welded_joints
from torchid.problem.unloaded_sensors import zero_in_air
from torchid.reading.log_steps import BLOCK_GB, LogSteps
from torchid.robot import payload_parameters, with_payload
from torchid.sensing import SensorSet

_WHOLE_GB = 2.0 * BLOCK_GB  # recorded arrays that are taken whole: no block is worth its neighbourhood


class LogReader:
    """Reads, preprocesses and binds logs; each on its own, so that nothing is differentiated across a seam.

    Logs whose arrays together take more than the memory they may take are kept on the disk from then on, all but bags.

    Attributes:
        setup: robot, contacts and settings.
        folder: on whose disk logs are kept, as long as they are used.
        excluded: how many samples of each log were left out because they are rejected, by path.
    """

    def __init__(self, setup: RobotSetup, folder: Path | None = None) -> None:
        """Nothing is read yet; without a `folder` it is the one that the output of the setup goes to, or a temporary.

        Raises:
            ConfigError: settings that leave the cutoff to the logs, where it has not been chosen.
        """
        if setup.config.preprocessing.cutoff_hz == "auto":
            raise ConfigError.at_field("preprocessing.cutoff_hz", "auto, not yet chosen", "a number [Hz] or null")
        self.setup = setup
        self.folder = _folder_beside(setup.config.output) if folder is None else folder
        self.excluded: dict[str, int] = {}
        self._held = 0.0  # arrays of logs in memory [GB]

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
                together = self._together(path)
                is_bag = existing_log_kind(path) is LogKind.BAG
                if together > self.setup.config.preprocessing.memory_gb and not is_bag:
                    logs.append(self._large(path, required, together))
                else:
                    logs.append(self._small(path, required))
                    self._held = together + (logs[-1].nbytes / GIGABYTE if is_bag else 0.0)
                if on_read is not None:
                    on_read(path)
        names = distributed.broadcast([log.source for log in logs], "names of the logs")  # they may lie elsewhere there
        added = [payload_of(self.setup, path) for path in paths]
        return [replace(log, source=name, payload=x) for log, name, x in zip(logs, names, added, strict=True)]

    def _together(self, path: Path) -> float:
        """What a log takes in memory with those before it [GB]."""
        return memory_needed(path, self.setup.config.preprocessing.memory_gb, self._held)

    def _small(self, path: Path, required: SensorSet | None) -> Samples:
        """A log that fits into memory."""
        settings = self.setup.config.preprocessing
        if self._takes_blocks(path, log_bytes(path, GIGABYTE * _WHOLE_GB) / GIGABYTE):
            return self._steps(path, required, None).samples(fits_contact_offsets(self.setup))
        read = self._recorded(path)
        own = setup_of_log(self.setup, path)
        acting = with_delayed_torques(without_welded_joints(read, own.robot), self.setup.config.actuators.known_delay)
        recorded, certain = apply_contact_settings(with_loop_joints(acting, own.robot), own)
        steps = self._steps(path, required, None)
        with_unloaded = fits_contact_offsets(self.setup)
        if not settings.exclude_rejected:
            warn_of_steps(recorded)
            return steps.samples_of(recorded, certain, with_unloaded)
        declared = replace(self.setup.declared, delay=0.0)  # the log has been read with it
        checked = check(recorded, own.robot, self.setup.contacts, settings.filter_hz, settings.derived, declared)

        def drop(samples: Samples, derived: bool) -> Samples:
            usable = drop_rejected(samples, checked, settings.filter_hz, derived)
            self.excluded[str(path)] = len(samples) - len(usable)
            return usable

        return steps.samples_of(recorded, certain, with_unloaded, checked.repaired, drop)

    def _recorded(self, path: Path) -> Log:
        """A log as it is in its file."""
        settings, files = self.setup.config.preprocessing, self.setup.config.logs
        topics, columns = (None, None) if files is None else (files.topics, files.columns)
        return read_log(
            path,
            topics,
            allow_gaps=settings.exclude_rejected,
            columns=columns,
            bridge_gaps_s=settings.bridge_gaps_s,
            needs_flags=settings.needs_flags,
        )

    def _large(self, path: Path, required: SensorSet | None, together: float) -> Samples:
        """A log that does not, with those before it [GB]."""
        settings = self.setup.config.preprocessing
        needed = f"a preprocessing.memory_gb above {together:.2g}"
        arrays = f"arrays of {together:.2g} GB, which are not in memory at once"
        if split_range(path).joins:
            found = f"several files with {arrays}"
            raise LogError(path, "file", found, f"{needed}, or the one file that torchid convert makes of them")
        if self.setup.config.actuators.known_delay:
            raise LogError(path, "actuators.delay", f"set for {arrays}", f"{needed}, or parts of the log")
        if settings.exclude_rejected:
            accepted = f"{needed}, or parts of the logs that torchid check passes"
            raise LogError(path, "preprocessing.exclude_rejected", f"set for {arrays}", accepted)
        return self._steps(path, required, self.folder).samples(fits_contact_offsets(self.setup))

    def _takes_blocks(self, path: Path, gigabytes: float) -> bool:
        """Whether a log with so much in arrays is read block by block even if there is memory for it.

        Where fields are worked out of others, blocks take more passes over it.
        """
        settings = self.setup.config.preprocessing
        filled = settings.bridge_gaps_s is not None or settings.zero_in_air
        logs, delayed = self.setup.config.logs, bool(self.setup.config.actuators.known_delay)
        joined = not has_blocks(path, None if logs is None else logs.columns)
        whole = settings.exclude_rejected or settings.derived or filled or delayed or joined
        return gigabytes > _WHOLE_GB and not whole and not self.setup.robot.loops

    def _steps(self, path: Path, required: SensorSet | None, folder: Path | None) -> LogSteps:
        """The steps from the log to samples."""
        setup = self.setup
        settings = setup.config.preprocessing
        return LogSteps(
            path,
            settings,
            setup.robot,
            setup.contacts,
            required,
            folder,
            motion_noise=setup.config.sensors.noise.motion,
            sign_width=setup.terms.sign_width,
            stribeck=setup.terms.stribeck,
            finds_rest=setup.config.actuators.known["stiction"],
            columns=None if setup.config.logs is None else setup.config.logs.columns,
            loaded=setup_of_log(setup, path).robot,
        )


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
        rest = settings.detect_contacts, settings.takes_possible_contacts, setup.terms.sign_width
        return with_detected_contacts(log, setup.robot, setup.contacts, *rest)
    if settings.contact_threshold is not None:
        return with_flags_by_force(log, settings.contact_threshold)
    return log, np.ones(len(log), dtype=bool)


def check_read(logs: Mapping[str, Sequence[Samples]]) -> None:
    """Make sure that no sample has two uses, which of parts of logs no file says, and that something is left to fit.

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
        found = "true, but all joints are at rest, or too near to it for the filter, throughout"
        raise LogError(train[0].source, "actuators.stiction", found, "logs whose joints move, or false")
    parts = {key: [split_range(log.source) for log in of_key] for key, of_key in logs.items()}
    spans = {split_range(log.source): log.time[[0, -1]].tolist() for of_key in logs.values() for log in of_key}

    def share(one: LogPart, other: LogPart) -> bool:
        (start, stop), (of_other, until) = spans[one], spans[other]
        return one.shares_samples(other) is None and start <= until and of_other <= stop

    require_apart(parts, share)


def fits_contact_offsets(setup: RobotSetup) -> bool:
    """Whether offsets of contact sensors are fitted, the only use of their readings in the air."""
    return any(channel.startswith("contact") for channel in setup.terms.offsets)


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
