"""What a cache holds: samples of one log with the warnings of reading them, and factors of training logs."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lxml import etree
from numpy.typing import NDArray
from pydantic import TypeAdapter
from torch import Tensor

from torchid import distributed
from torchid.checksums import file_checksum
from torchid.config.robot import RobotConfig
from torchid.errors import TorchidWarning
from torchid.fitting.experiment import Experiment, RobotSetup
from torchid.fitting.factor_documents import PackedPart, PartPacker, PartReader
from torchid.logs.lazy_arrays import MappedPages
from torchid.logs.time_range import log_title
from torchid.problem import RowBuilder, Samples
from torchid.problem.base_motion import BaseMotion
from torchid.problem.chunks import worker_count
from torchid.problem.motion_noise import MotionNoise
from torchid.problem.parts import Part
from torchid.reading.cache import Cache, CacheEntry, content_key, tensor_of
from torchid.reading.log_reader import fits_contact_offsets
from torchid.robot import Robot
from torchid.robot.urdf import parse_xml

NOT_IN_SAMPLES = ("memory_gb", "cache_gb")
"""Keys of preprocessing that do not change what the samples of a log are that is read whole."""

RecordedWarning = tuple[type[Warning], str]
"""Class and text of a warning."""

_SAMPLES_FORMAT = 4  # of entries
_BASE = "base."  # before the names of tensors of the base's motion
_MOTION = ("time", "joint_", "direction", "share", "stribeck", _BASE)  # begin the names of tensors without NaN


@dataclass(frozen=True)
class ReadLog:
    """Samples of a log, how many were left out, and the warnings of reading.

    `excluded`: None where the settings leave nothing out.
    """

    samples: Samples
    excluded: int | None
    warned: list[RecordedWarning]


def content_of_setup(setup: RobotSetup) -> dict[str, Any]:
    """All that the samples of a log depend on beside the log, as a document.

    Of the sensors that are fitted it is whether contacts have offsets: then samples have readings in the air.
    """
    config, robot = setup.config, setup.robot
    settings = {name: x for name, x in asdict(config.preprocessing).items() if name not in NOT_IN_SAMPLES}
    topics = None if config.logs is None or config.logs.topics is None else asdict(config.logs.topics)
    columns = None if config.logs is None or config.logs.columns is None else asdict(config.logs.columns)
    return {
        "format": _SAMPLES_FORMAT,
        "urdf": [config.robot.path.name, _robot_checksum(config.robot)],
        "robot": [robot.base_link, robot.fixed_base, list(robot.ft_names), robot.welded, robot.base_tilt],
        "mass": float(robot.nominal[:, 0].sum()),  # stated, of a URDF without
        **_loops(robot),
        "contacts": [asdict(contact) for contact in setup.contacts],
        "unloaded": fits_contact_offsets(setup),
        "preprocessing": settings,
        "motion_noise": config.sensors.noise.motion,
        "sign_width": config.actuators.known["sign_width"],
        "delay": config.actuators.known_delay,
        **({} if config.actuators.stribeck is None else {"stribeck": config.actuators.stribeck}),
        **({"stiction": True} if config.actuators.known["stiction"] else {}),
        "topics": topics,
        "columns": json.dumps(columns),  # as text: the order of names in it is that of the log
    }


def _loops(robot: Robot) -> dict[str, Any]:
    """Loops and passive joints; nothing of a robot without, whose entries stay what they were."""
    if not (robot.loops or robot.passive):
        return {}
    return {"loops": [asdict(loop) for loop in robot.loops], "passive": list(robot.passive)}


def _robot_checksum(robot: RobotConfig) -> str:
    """SHA-256 of a URDF; of MJCF that of what is read from it and the files that it includes."""
    if robot.mjcf is None:
        return file_checksum(robot.path)
    return hashlib.sha256(etree.tostring(parse_xml(robot.path))).hexdigest()


def named_tensors(samples: Samples) -> dict[str, Tensor]:
    """All tensors by the names that their files have in an entry."""
    own = {name: x for name, x in vars(samples).items() if isinstance(x, Tensor)}
    return own | {_BASE + name: x for name, x in vars(samples.base).items() if isinstance(x, Tensor)}


def samples_entry(read: ReadLog) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """The document and the arrays of an entry; axes are in the order of the strides, which come back with them."""
    samples, arrays, axes = read.samples, dict[str, NDArray[Any]](), dict[str, list[int]]()
    for name, x in named_tensors(samples).items():
        axes[name] = sorted(range(x.ndim), key=lambda axis, x=x: -x.stride(axis))  # type: ignore[misc]
        arrays[name] = x.numpy().transpose(axes[name])
    document = {
        "source": samples.source,
        "samples": {name: x for name, x in vars(samples).items() if isinstance(x, (bool, int, float))},
        "axes": axes,
        "motion_noise": _noise_document(samples.motion_noise),
        "excluded": read.excluded,
        "warnings": [
            [category.__name__, message] for category, message in read.warned if category in _stored_categories()
        ],
    }
    return document, arrays


def samples_of_entry(entry: CacheEntry, source: str, folder: Path | None) -> ReadLog:
    """What was stored, of a log of this name; any exception where that is something else.

    Args:
        entry: of the cache.
        source: name of the log.
        folder: as `Samples` has it.
    """
    document, base = entry.document, dict[str, Tensor]()
    own: dict[str, Any] = {"torque": None, "wrench": None}
    for name, axes in document["axes"].items():
        tensor = tensor_of(entry.arrays[name].transpose(np.argsort(axes)))
        if name.startswith(_BASE):
            base[name.removeprefix(_BASE)] = tensor
        else:
            own[name] = tensor
    noise = _noise_of_document(document["motion_noise"])
    pages = MappedPages(entry.arrays.values())
    samples = Samples(
        source, base=BaseMotion(**base), folder=folder, motion_noise=noise, pages=pages, **own, **document["samples"]
    )
    moving = (x for one in samples.pieces() for name, x in named_tensors(one).items() if name.startswith(_MOTION))
    if not all(x.isfinite().all() for x in moving):
        raise ValueError("a number that is not finite")
    categories = {category.__name__: category for category in _stored_categories()}
    warned = [(categories[name], _about(source, document["source"], text)) for name, text in document["warnings"]]
    return ReadLog(samples, document["excluded"], warned)


def _noise_document(noise: MotionNoise | None) -> dict[str, Any] | None:
    if noise is None:
        return None
    return {name: x.tolist() if isinstance(x, Tensor) else x for name, x in vars(noise).items()}


def _noise_of_document(document: dict[str, Any] | None) -> MotionNoise | None:
    if document is None:
        return None
    joints, base = (torch.tensor(document[name], dtype=torch.float64) for name in ("joints", "base"))
    return MotionNoise(joints.reshape(-1, 3, 3), base.reshape(12, 12), bool(document["turns_force"]))


def _about(source: str, before: str, text: str) -> str:
    """A warning about a log, about one with the same content."""
    names = {before: source, log_title(before): log_title(source)}
    return re.sub("|".join(map(re.escape, names)), lambda found: names[found[0]], text)


def _stored_categories() -> list[type[Warning]]:
    """Warnings that are for users: torchid's, and those of libraries about numbers."""
    out: list[type[Warning]] = [TorchidWarning, RuntimeWarning]
    for category in out:
        out += category.__subclasses__() if category is not RuntimeWarning else []
    return out


_FACTORS_FORMAT = 3  # of entries
_PARTS = TypeAdapter(list[PackedPart])


def factors_key(experiment: Experiment, builder: RowBuilder, samples: Sequence[str], blocks: Sequence[Samples]) -> str:
    """The name of the factors of training logs: of whatever changes the last bit of one.

    Args:
        experiment: with the noise that rows are weighted with.
        builder: of the rows.
        samples: names of the samples of each log, see `CachedReader.keys`.
        blocks: the logs in folds.
    """
    sensors, sources = experiment.sensors, list(dict.fromkeys(block.source for block in blocks))
    return content_key(
        {
            "format": _FACTORS_FORMAT,
            "samples": list(samples),
            "sensors": [sensors.torque.tolist(), sensors.wrench.tolist()],
            "noise": vars(sensors.noise),
            "weights": None if sensors.task_weights is None else sensors.task_weights.tolist(),
            "terms": vars(experiment.terms),
            "blocks": [[sources.index(block.source), len(block), block.fold] for block in blocks],
            "motion_noise": [block.motion_noise is not None for block in blocks],
            "device": builder.device.type,
            "shares": [worker_count(builder.device), distributed.world_size()],  # rows are added up by each
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
    there = all(distributed.all_gather(found is not None, "factors in the cache"))
    if there and found is not None:
        return found, True
    parts = compute()
    if distributed.is_first():
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


def _unpacked(entry: CacheEntry, builder: RowBuilder, sources: Sequence[str]) -> list[Part]:
    """What was stored, of logs of these names; any exception where that is something else."""
    document, columns = entry.document, builder.width
    if not np.isfinite(values := entry.arrays["values"]).all():
        raise ValueError("a number that is not finite")
    reader = PartReader(values, document["supports"], columns, len(builder.contacts), len(builder.extras))
    parts = []
    for packed, (source, fold, block, unloaded) in zip(
        _PARTS.validate_python(document["parts"]), document["of"], strict=True
    ):
        parts.append(replace(reader.read(sources[source], packed, unloaded), fold=fold, block=block))
    if reader.numbers_left:
        raise ValueError("more numbers than are described")
    return parts
