"""How an experiment file has logs read: maps of topics and columns, and the block `preprocessing`.

`torchid check` and `convert` need no more, and read the maps for themselves.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BeforeValidator
from pydantic.dataclasses import dataclass

from torchid.config.settings_files import FileKind, Settings, load
from torchid.errors import about_file
from torchid.logs import Columns, Topics
from torchid.logs.columns import check_columns
from torchid.logs.flags import ContactThreshold
from torchid.logs.ros_topics import check_topics
from torchid.logs.unitree import JOINT_ORDERS
from torchid.problem.contact_detection import DetectionConfig
from torchid.settings import AUTO, STRICT, NotNegativeAutoOrNone, Positive, PositiveOrAuto


def _switch(value: object) -> object:
    """All settings at their defaults for true, none for false."""
    return ({} if value else None) if isinstance(value, bool) else value


def _threshold(value: object) -> object:
    """A number is the threshold of both changes."""
    if isinstance(value, str):
        raise ValueError("a force [N], or a mapping with above, below, shortest_s")
    return {"above": value} if isinstance(value, (int, float)) else value


@dataclass(config=STRICT, frozen=True)
class PreprocessingConfig:
    """Zero-phase low-pass [Hz] and resampling [Hz]; None leaves the signals as they are.

    `cutoff_hz`: auto, one that the motion of the training logs and its noise ask for, see `choose_cutoff`.
    `sample_rate_hz`: auto, every k-th sample of a log that is filtered, see `lay_out_timeline`.
    `bridge_gaps_s`: gaps (NaN) of at most so long [s] are filled before anything else is done; None leaves them.
    `contact_margin_s`: samples that are dropped before and after each change of contact [s], None for none;
    auto, as many as make the fit worse where feet stand (`torchid.fitting.left_out`).
    `detect_contacts`: true, or its settings, for contact flags from joint torques (`DetectionConfig`) in the place of
    recorded ones.
    `contact_threshold`: a force [N], or its settings, for contact flags from forces (`ContactThreshold`) likewise.
    `zero_in_air`: subtract from contact sensors what they read on average in the air, from each log for itself.
    `base_motion`: contacts, from the feet that stand on a floor, whatever was recorded of it; None for as recorded.
    `max_slip`: speed [m/s] above which a contact that should stand slips, so that the sample is dropped; auto, from the
    noise of each contact's velocity; None keeps all.
    `exclude_rejected`: leave out the samples that `torchid check` rejects.
    `memory_gb`: a log whose arrays take more than an eighth [GB] is read in parts, its samples kept on the disk.
    """

    cutoff_hz: PositiveOrAuto = None
    sample_rate_hz: PositiveOrAuto = None
    bridge_gaps_s: Positive | None = None
    contact_margin_s: NotNegativeAutoOrNone = None
    detect_contacts: Annotated[DetectionConfig | None, BeforeValidator(_switch)] = None
    contact_threshold: Annotated[ContactThreshold | None, BeforeValidator(_threshold)] = None
    zero_in_air: bool = False
    base_motion: Literal["contacts"] | None = None
    max_slip: PositiveOrAuto = None
    exclude_rejected: bool = False
    memory_gb: Positive = 2.0

    @property
    def filter_hz(self) -> float | None:
        """The cutoff as a number [Hz], None where there is no filter, or it has not been chosen."""
        return None if isinstance(self.cutoff_hz, str) else self.cutoff_hz

    @property
    def slip_limit(self) -> float | None:
        """The stated speed [m/s] above which a contact slips, None where it follows from the noise."""
        return None if isinstance(self.max_slip, str) else self.max_slip

    @property
    def margin_s(self) -> float | None:
        """Samples that are dropped before and after each change of contact [s], None for none."""
        stated = None if self.contact_margin_s == AUTO else self.contact_margin_s
        margins = [stated, None if self.detect_contacts is None else self.detect_contacts.margin_s]
        return max((margin for margin in margins if margin is not None), default=None)

    @property
    def derived(self) -> tuple[str, ...]:
        """How names of fields of a log begin that are worked out of others, whatever was recorded."""
        flags = () if self.needs_flags else ("contact_active",)
        return flags if self.base_motion is None else (*flags, "base_")

    @property
    def takes_possible_contacts(self) -> bool:
        """Whether detected flags may be those of contacts that may stand: nothing takes it that they keep still."""
        return self.base_motion is None and self.max_slip is None

    @property
    def needs_flags(self) -> bool:
        """Whether nothing but a log says which contact touches when."""
        return self.detect_contacts is None and self.contact_threshold is None


_ORDER = f"a list of names, or a robot: {', '.join(JOINT_ORDERS)}"
MAPS_ACCEPTED = {
    **{f"logs.columns.{kind}_order": _ORDER for kind in ("joint", "contact")},
    **{f"logs.columns.{key}": "a list of names" for key in ("sensor_order", "ignore")},
    "logs.columns.other_times": "a list of entries like time: [{column: stamp, unit: ms}]",
    "logs.columns.plates": "poses by contact: {l_foot: {position: [0.3, 0.2, 0], rpy_deg: [180, 0, 90]}}",
    "logs.columns.*": "the name of a column, a pattern such as {joint}_q, or a mapping with column, unit, scale, ...",
    "logs.topics.joint_states": "the name of a topic, or a mapping with topic and joints",
    "logs.topics.other_joint_states": "a list of entries like joint_states: [/arms/joint_states]",
    "logs.topics.low_state": "a mapping with topic and robot, or joints by number of the motor",
}
"""Accepted for entries of maps, in messages, where their types alone say too little."""

T = TypeVar("T")


@dataclass(config=STRICT, frozen=True)
class _TopicsOfLogs:
    topics: Topics


@dataclass(config=STRICT, frozen=True)
class _TopicsFile:
    logs: _TopicsOfLogs


@dataclass(config=STRICT, frozen=True)
class _ColumnsOfLogs:
    columns: Columns


@dataclass(config=STRICT, frozen=True)
class _ColumnsFile:
    logs: _ColumnsOfLogs


def _kind(settings: type[T], key: str, example: str) -> FileKind[T]:
    """An experiment file of which one key of `logs` counts."""

    def prepare(settings: Settings, _: Settings) -> Settings:
        logs = settings.get("logs")
        return {"logs": {name: x for name, x in logs.items() if name == key} if isinstance(logs, dict) else {}}

    name, keys, example = "experiment", f"logs.{key}", f"logs.{key}.{example}"
    return FileKind(
        settings=settings, name=name, keys=keys, list_example=example, prepare=prepare, accepted=MAPS_ACCEPTED
    )


_TOPICS = _kind(_TopicsFile, "topics", "joint_states.joints=[l_knee]")
_COLUMNS = _kind(_ColumnsFile, "columns", "joint_order=[l_knee]")


def load_topics(path: str | Path) -> Topics:
    """Read `logs.topics` from an experiment file, whatever its other keys are.

    Raises:
        ConfigError: unreadable file, no `logs.topics`, a value of the wrong kind.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    topics = load(_TOPICS, Path(path)).logs.topics
    with about_file(path):
        check_topics(topics)
    return topics


def load_columns(path: str | Path) -> Columns:
    """Read `logs.columns` from an experiment file, as `load_topics` does `logs.topics`."""
    columns = load(_COLUMNS, Path(path)).logs.columns
    with about_file(path):
        check_columns(columns)
    return columns
