"""Contacts and the base's motion of a log that is read block by block, worked out of its other fields."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.arrays import parse_names
from torchid.logs.blocks import LogBlocks
from torchid.logs.flags import ContactThreshold, MeasuredForces, flags_by_force
from torchid.logs.gaps import Coverage
from torchid.logs.lazy_arrays import Computed, Filled, GapsFilled, Spill, growing_array
from torchid.logs.log import CONTACT_READINGS, FLAGS, FORCE_NORMAL, NORMALS, WRENCHES, BoolArray, FloatArray
from torchid.logs.preprocess import (
    find_unloaded,
    gapless_fields,
    lacks_derivatives,
    move_to_timeline,
    unloaded_readings,
)
from torchid.logs.timeline import SPLINE_BLOCK, lay_out_timeline
from torchid.problem.base_pose import (
    PoseSegments,
    base_pose_in_parts,
    feet_poses,
    points_that_stand,
    require_floor_normals,
    require_no_heading,
    sole_axes,
    standing_flags,
)
from torchid.problem.contact_detection import Detection, DetectionConfig, Filtered, detect_in_parts, name_flags
from torchid.problem.detection_motion import (
    MAX_GAPS,
    DetectionSamples,
    bind_for_detection,
    filter_hz,
    for_detection,
    quiet,
    require_torque,
)
from torchid.problem.floor_pose import Footholds, StanceFoot, foot_to_base
from torchid.problem.unloaded_sensors import offsets_in_the_air
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.sensing.sensors import UP

Pieces = Callable[[int], Iterator[slice]]
"""Successive parts of so many samples, each of which fits into memory."""

OF_MOTION = ("joint_position", "joint_velocity", "joint_acceleration", "base_", "imu_")
"""How names of fields of the motion begin."""


def motion_fields(blocks: LogBlocks, *more: str) -> tuple[str, ...]:
    """Names of the fields of a log that are its motion, and others that it has."""
    return tuple(name for name in blocks.fields if name.startswith((*OF_MOTION, *more)))


def contact_names(blocks: LogBlocks) -> tuple[str, ...]:
    """Names of a log's contacts."""
    return parse_names("contact_names", blocks.names["contact_names"]) if "contact_names" in blocks.names else ()


# ---------------------------------------------------------------------------------------------------- detected contacts


def detect_in_blocks(
    blocks: LogBlocks,
    robot: Robot,
    contacts: Sequence[Contact],
    settings: DetectionConfig,
    pieces: Pieces,
    folder: Path | None,
    sign_width: float | None = None,
) -> Detection:
    """As `detect_contacts`; a pass over the torques, and two or more that filter them and the motion.

    Args:
        blocks: the log as recorded.
        robot: the robot.
        contacts: that may stand, one or more.
        settings: thresholds.
        pieces: in which it is read.
        folder: with room for forces and velocities of the contacts; None: in memory.
        sign_width: as of `detect_contacts`.

    Raises:
        InputError: as `detect_contacts`; a tilted floor below a base whose tilt was not measured.
    """
    require_torque(blocks.source, "joint_torque" in blocks.fields)
    _require_level_or_measured(blocks, contacts)
    recorded = (blocks.read(piece, only=("joint_torque",)).joint_torque for piece in pieces(len(blocks)))
    torque = GapsFilled(blocks.fields["joint_torque"], MAX_GAPS, (x for x in recorded if x is not None))
    filled = blocks.replaced({"joint_torque": torque})
    names = motion_fields(filled, "joint_torque")
    first = for_detection(filled.read(slice(0, SPLINE_BLOCK), names))

    def filtered(cutoff_hz: float) -> Filtered:
        with quiet():
            cutoff = filter_hz(cutoff_hz, blocks.time)
            timeline = lay_out_timeline(blocks.time, cutoff, None, lacks_derivatives(first))
        coverage = {name: Coverage.empty(torque.shape[1:]) for name in gapless_fields(first, timeline)}
        for one in coverage.values():
            one.add(np.where(torque.broken, np.nan, 0.0)[None], None)

        def parts() -> Iterator[DetectionSamples]:
            for piece in pieces(len(timeline.output_stamps)):
                samples, part = timeline.part(piece.start, piece.stop)
                with quiet():
                    known = move_to_timeline(for_detection(filled.read(samples, names)), part, coverage)
                yield bind_for_detection(known, robot, contacts)

        return Filtered(timeline.stamps_of(blocks.time), cutoff_hz, parts)

    return detect_in_parts(filtered, blocks.time, robot, contacts, settings, sign_width, folder)


def _require_level_or_measured(blocks: LogBlocks, contacts: Sequence[Contact]) -> None:
    """Refuse a tilted floor where the base's tilt was not measured: its heading there follows from the whole log."""
    measured = "imu_frame" in blocks.names or any(name.startswith("base_quat") for name in blocks.fields)
    if not measured and any(contact.normal != UP for contact in contacts):
        found = "missing, with detect_contacts on a tilted floor in a log that is not in memory at once"
        accepted = "the base's orientation or an IMU, a larger preprocessing.memory_gb, or parts of the log"
        raise LogError(blocks.source, "base_quat_xyzw", found, accepted)


def with_flags(blocks: LogBlocks, contacts: Sequence[Contact], active: BoolArray) -> LogBlocks:
    """The log with flags (N, C) of an experiment's contacts; LogError as `name_flags`."""
    has_readings = any(name in blocks.fields for name in (*CONTACT_READINGS, NORMALS))
    given = contact_names(blocks) if has_readings else ()
    names, flags = name_flags(blocks.source, given, contacts, active)
    return blocks.replaced({"contact_active": flags}, {"contact_names": np.array(names, dtype=np.str_)})


# -------------------------------------------------------------------------------------------------------- standing base


def base_pose_in_blocks(
    blocks: LogBlocks, robot: Robot, contacts: Sequence[Contact], pieces: Pieces, folder: Path | None
) -> tuple[LogBlocks, PoseSegments]:
    """As `base_pose_from_feet`: the log with the base's pose where it is known, and where; passes over the joints.

    Args:
        blocks: the log, with flags.
        robot: the robot.
        contacts: its feet.
        pieces: in which it is read.
        folder: with room for the poses; None: in memory.

    Raises:
        LogError: as `base_pose_from_feet`.
    """
    active = _active(blocks, contacts, pieces)
    parts = list(pieces(len(blocks)))

    def joints(samples: slice) -> Log:
        return blocks.read(samples, only=("joint_position",))

    axes = _sole_axes(joints, active, robot, contacts, parts)

    def footholds(samples: slice) -> Footholds:
        poses = feet_poses(joints(samples), robot, contacts)
        feet = [StanceFoot.of(x, poses[x.frame], axis) for x, axis in zip(contacts, axes, strict=True)]
        return Footholds.of(feet, points_that_stand(active[samples], contacts))

    quats, positions = (growing_array(blocks.source, folder, len(blocks)) for _ in range(2))
    length = 0

    def add(samples: slice, quat: FloatArray, position: FloatArray) -> None:
        nonlocal length
        for grows, rows in ((quats, quat), (positions, position)):
            _skip(grows, samples.start - length, rows.shape[1])
            grows.append(rows)
        length = samples.stop

    found = base_pose_in_parts(blocks.source, contacts, active, footholds, parts, add)
    _skip(quats, len(blocks) - length, 4)
    _skip(positions, len(blocks) - length, 3)
    fields: dict[str, Any] = {name: None for name in (*motion_fields(blocks), NORMALS) if not name.startswith("joint_")}
    fields |= {"base_quat_xyzw": quats.array(), "base_position_world": positions.array()}
    return blocks.replaced(fields, {"imu_frame": None}), found


def _skip(grows: Filled | Spill, count: int, width: int) -> None:
    """Add samples of which nothing is known."""
    for start in range(0, count, SPLINE_BLOCK):
        grows.append(np.full((min(SPLINE_BLOCK, count - start), width), np.nan))


def _active(blocks: LogBlocks, contacts: Sequence[Contact], pieces: Pieces) -> BoolArray:
    """Which contacts stand, (N, C), in a log whose readings need no heading of the base."""
    require_no_heading(blocks.source, WRENCHES[1] in blocks.fields)
    names, out = contact_names(blocks), []
    for piece in pieces(len(blocks)):
        log = blocks.read(piece, only=("contact_active", NORMALS))
        active = standing_flags(blocks.source, names, log.contact_active, contacts)
        require_floor_normals(blocks.source, names, log.contact_normal_world, active, contacts)
        out.append(active)
    return np.concatenate(out)


def _sole_axes(
    joints: Callable[[slice], Log], active: BoolArray, robot: Robot, contacts: Sequence[Contact], parts: Sequence[slice]
) -> list[int]:
    """Axes along the normals of flat feet, which takes a pass over the joints if there are any."""
    sums: list[FloatArray | None] = [None] * len(contacts)
    flat = [index for index, contact in enumerate(contacts) if contact.kind == "flat"]
    for part in parts if flat else ():
        poses = feet_poses(joints(part), robot, contacts)
        for index in flat:
            ways = foot_to_base(poses[contacts[index].frame])[active[part, index]]
            if len(ways):
                before = sums[index]
                sums[index] = ways.sum(axis=0) if before is None else before + ways.sum(axis=0)
    return sole_axes(contacts, sums)


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
