"""Which contacts stand when, from joint torques and the robot's own dynamics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from torchid import ranks
from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.flags import hysteresis, runs, samples_of, without_short
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import find_unloaded
from torchid.logs.spill import growing_array
from torchid.parameters import FRICTION, PER_BODY
from torchid.problem.compression import compress_parts
from torchid.problem.contact_slip import base_velocity, contact_velocities
from torchid.problem.detection_forces import ForcesAlongNormals
from torchid.problem.detection_motion import Prepared, detection_cutoff_hz, prepare
from torchid.problem.elimination import assemble
from torchid.problem.extras import ExtraTerms
from torchid.problem.linear import PRIOR_DEVIATION, LinearProblem
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.robot import Robot
from torchid.rounding import STD_PER_MAD
from torchid.sensing import Contact, named_sensors
from torchid.settings import NotNegative, Positive

_SUPPORTED = 0.25  # of the weight: what contact forces may leave of it in samples that parameters are fitted to
_LEAST_FITTED = 100  # samples
_DEVIATIONS = 3.0  # of what feet seem to carry in the air, to which thresholds go down
_LOWEST = 0.01  # of the stated thresholds


@dataclass(config=ConfigDict(extra="forbid"), frozen=True)
class DetectionConfig:
    """How contacts are detected.

    A contact stands from where its normal force exceeds `touch` until it is below `lift`, shares of the robot's
    weight by the URDF. Where the base's motion was measured, it stands also while it carries more than `light` and
    keeps still, for twice `shortest_s` at least. Torques are low-pass filtered before (`cutoff_hz`, zero phase);
    stances and swings shorter than `shortest_s` [s] are none. Samples within `margin_s` [s] of a change are dropped, as
    are those within `preprocessing.contact_margin_s`.

    With `refit`, where the base's acceleration is known, parameters are then fitted to each log with the contacts that
    were found, and contacts detected again with these: by thresholds that are lower in the same ratio, three standard
    deviations of what feet seem to carry in the air. Samples in which both thresholds differ are dropped.
    """

    touch: Positive = 0.02
    lift: NotNegative = 0.015
    light: NotNegative = 0.005
    cutoff_hz: Positive = 20.0
    shortest_s: NotNegative = 0.04
    margin_s: NotNegative = 0.02
    refit: bool = True


def with_detected_contacts(
    log: Log, robot: Robot, contacts: Sequence[Contact], settings: DetectionConfig | None = None
) -> tuple[Log, BoolArray]:
    """The log with flags of all contacts by `detect_contacts` in the place of what it has, and where they are certain.

    Raises:
        LogError: as `detect_contacts`; wrenches without the name of a contact.
    """
    active, certain = detect_contacts(log, robot, contacts, settings or DetectionConfig())
    bare = log.contact_wrench is None and log.contact_force_normal is None and log.contact_normal_world is None
    names, flags = name_flags(log.source, () if bare else log.contact_names, contacts, active)
    return dataclasses.replace(log, contact_names=names, contact_active=flags), certain


def name_flags(
    source: str, names: tuple[str, ...], contacts: Sequence[Contact], active: BoolArray
) -> tuple[tuple[str, ...], BoolArray]:
    """Names of the contacts of a log and their flags (N, C'), of flags (N, C) of the experiment's contacts.

    Args:
        source: name of the log.
        names: of contacts of which it has readings, () without any.
        contacts: of the experiment.
        active: their flags.

    Raises:
        LogError: readings without the name of a contact.
    """
    frames = tuple(contact.frame for contact in contacts)
    if not names:
        return frames, active
    if missing := [frame for frame in frames if frame not in names]:
        raise LogError(source, "contact_names", f"contact '{missing[0]}' missing", "every contact of the experiment")
    flags = np.zeros((len(active), len(names)), dtype=bool)
    flags[:, [names.index(frame) for frame in frames]] = active
    return names, flags


class Detection(NamedTuple):
    """Which contacts stand.

    Attributes:
        active: (N, C).
        certain: samples (N,) that a fit may trust: neither those at both ends of a log, which the filter spoils, nor
            stances that were too short to count.
    """

    active: BoolArray
    certain: BoolArray


def detect_contacts(log: Log, robot: Robot, contacts: Sequence[Contact], settings: DetectionConfig) -> Detection:
    """Which contacts stand when.

    Args:
        log: as recorded, with the torques of all joints above the contacts.
        robot: the robot, whose base floats.
        contacts: that may stand.
        settings: thresholds.

    Raises:
        LogError: no torques, fewer than three of joints above a contact, or joints that are missing.
        InputError: a cutoff that does not suit the log.
    """
    if not contacts:
        return Detection(np.zeros((len(log), 0), dtype=bool), np.ones(len(log), dtype=bool))
    whole = prepare(log, robot, contacts, settings.cutoff_hz)
    return detect_in_parts(lambda: [whole], whole.log.time, log.time, robot, contacts, settings)


def detect_in_parts(
    parts: Callable[[], Iterable[Prepared]],
    time: FloatArray,
    stamps: FloatArray,
    robot: Robot,
    contacts: Sequence[Contact],
    settings: DetectionConfig,
    folder: Path | None = None,
) -> Detection:
    """As `detect_contacts`, of a log that is prepared in successive parts.

    Args:
        parts: called for each of two passes, or three with `refit`.
        time: (K,) [s] of all samples of the parts.
        stamps: (N,) [s] of the log as recorded.
        robot: the robot.
        contacts: one or more.
        settings: thresholds.
        folder: with room for forces and velocities; None: in memory.
    """
    forces = ForcesAlongNormals.of(parts(), len(time), robot, contacts)
    shares, velocities = (growing_array("contacts", folder, len(time)) for _ in range(2))
    in_world = moves = accelerates = False
    for part in parts():
        shares.append(forces.of_part(part) / forces.balance.weight)
        in_world, moves = (base := base_velocity(part.log, part.samples)) is not None, part.base_is_known
        accelerates = moves and part.acceleration_is_known
        if moves:
            velocities.append(contact_velocities(part.samples, robot, contacts, base))
    judged = _Judged(time, velocities.array() if moves else None, in_world, settings)
    found = judged.by(shares.array())
    if settings.refit and accelerates and (again := _fitted(forces, found, judged)) is not None:
        shares = growing_array("contacts", folder, len(time))
        for part in parts():
            shares.append(again.of_part(part) / again.balance.weight)
        found = judged.finer(shares.array(), find_unloaded(time, found.active, judged.smear_s))
    nearest = np.searchsorted(0.5 * (time[1:] + time[:-1]), stamps)
    inside = (stamps >= time[0]) & (stamps <= time[-1])
    return Detection(found.active[nearest], inside & found.certain[nearest])


@dataclasses.dataclass(frozen=True)
class _Judged:
    """Contacts at stamps (K,) [s] with velocities (K, C, 3) [m/s], in the world or not, None where nobody knows."""

    time: FloatArray
    velocity: FloatArray | None
    in_world: bool
    settings: DetectionConfig

    @property
    def smear_s(self) -> float:
        """How far [s] from a change of contact its filtered force is seen."""
        return 1.0 / detection_cutoff_hz(self.settings.cutoff_hz, self.time)

    def by(self, share: FloatArray) -> Detection:
        """Which contacts stand that carry shares (K, C) of the weight."""
        settings, shortest = self.settings, samples_of(self.settings.shortest_s, self.time)
        loaded = np.stack([hysteresis(one, settings.touch, settings.lift) for one in share.T], axis=1)
        if self.velocity is not None:
            loaded |= keep_still(self.velocity, self.in_world, loaded, share > settings.light, 2 * shortest)
        flags = np.stack([without_short(one, shortest) for one in loaded.T], axis=1)
        return Detection(flags, ~np.asarray((loaded & ~flags).any(axis=1)))

    def finer(self, share: FloatArray, in_the_air: BoolArray) -> Detection:
        """As `by`, with thresholds as low as the shares of contacts that are in the air (K, C) allow.

        Certain is what the settings' own thresholds say too: they differ from before a foot touches until it carries
        something, with an impact between.
        """
        found = self.by(share)
        if in_the_air.sum() < _LEAST_FITTED:
            return found
        noise = STD_PER_MAD * float(np.median(np.abs(share[in_the_air])))
        factor = float(np.clip(_DEVIATIONS * noise / self.settings.touch, _LOWEST, 1.0))
        lower = {name: factor * getattr(self.settings, name) for name in ("touch", "lift", "light")}
        finer = dataclasses.replace(self, settings=dataclasses.replace(self.settings, **lower)).by(share)
        return Detection(finer.active, found.certain & (finer.active == found.active).all(axis=1))


def _fitted(forces: ForcesAlongNormals, found: Detection, judged: _Judged) -> ForcesAlongNormals | None:
    """The forces of the robot with parameters that fit its torques with the contacts that were found; None without any.

    Of samples away from changes in which contacts carry the robot: a belly or a rope leaves a part of its weight.
    """
    away = [find_unloaded(judged.time, active, judged.smear_s) for active in (found.active, ~found.active)]
    sure = (found.certain & (away[0] | away[1]).all(axis=1))[forces.chosen]
    kept = np.flatnonzero(sure & (forces.unexplained < _SUPPORTED * forces.balance.weight))
    if len(kept) < _LEAST_FITTED:
        return None
    active = torch.from_numpy(found.active[forces.chosen[kept]])
    samples = dataclasses.replace(forces.samples[torch.from_numpy(kept)], active=active)
    return forces.with_parameters(fitted_parameters(samples, forces.balance.robot, forces.balance.contacts))


LEAST_LIMIT = 0.01
"""Speed [m/s] below which a contact always counts as still: what soft ground and filters leave of a stance."""

_TOGETHER = 1 << 16  # samples whose speeds are worked out at once
_MEDIANS = 2.0  # of the speed of contacts that surely stand, which is noise


def keep_still(
    velocity: FloatArray, in_world: bool, standing: BoolArray, possible: BoolArray, shortest: int
) -> BoolArray:
    """Which contacts that may stand move no faster than those that surely do, for some samples at least, (N, C).

    Args:
        velocity: of the contacts (N, C, 3) [m/s], from `contact_velocities`.
        in_world: whether that is in the world, as the log has the velocity of its base; else speeds are those against
            the median of the other contacts that surely stand.
        standing: those that surely stand, (N, C).
        possible: those that may stand, (N, C).
        shortest: samples in a row.
    """
    speed = np.empty(standing.shape)
    for start in range(0, len(speed), _TOGETHER):
        part = slice(start, start + _TOGETHER)
        seen = velocity[part] if in_world else _against_standing(velocity[part], standing[part])
        speed[part] = np.linalg.norm(seen, axis=2)
    noise = speed[standing & np.isfinite(speed)]
    limit = max(LEAST_LIMIT, _MEDIANS * float(np.median(noise))) if len(noise) else LEAST_LIMIT
    with np.errstate(invalid="ignore"):
        still = (speed < limit) & possible
    return np.stack([_lasting(one, shortest) for one in still.T], axis=1)


def _lasting(flags: BoolArray, shortest: int) -> BoolArray:
    """The flags (N,) without runs of fewer true ones."""
    out = np.zeros_like(flags)
    for start, stop in runs(flags):
        out[start:stop] = stop - start >= shortest
    return out


def _against_standing(velocity: FloatArray, standing: BoolArray) -> FloatArray:
    """Velocities (N, C, 3) against the median of the other contacts that stand; NaN where none does."""
    out = np.full_like(velocity, np.nan)
    for contact in range(velocity.shape[1]):
        others = np.where(standing[:, :, None], velocity, np.nan)
        others[:, contact] = np.nan
        some = np.isfinite(others[:, :, 0]).any(axis=1)
        out[some, contact] = velocity[some, contact] - np.nanmedian(others[some], axis=1)
    return out


_PASSES = 3  # over the variance of what the parameters leave, which settles at once


def fitted_parameters(samples: Samples, robot: Robot, contacts: Sequence[Contact]) -> FloatArray:
    """Parameters (L, 12) of a robot without friction, which was fitted with them, as armatures were.

    Args:
        samples: with joint torques and the contacts that stand; torques without a value count as not measured.
        robot: for the prior.
        contacts: none of which is measured.
    """
    sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
    if samples.torque is not None:
        sensors = dataclasses.replace(sensors, torque=sensors.torque & samples.torque.isfinite().all(dim=0).numpy())
    builder = RowBuilder(robot, contacts, sensors, ExtraTerms(armature=True))
    with ranks.apart():  # each process has logs of its own
        problem = assemble(compress_parts([samples], builder), builder, robot).problem
    phi = most_probable(problem).reshape(-1, PER_BODY)
    phi[:, FRICTION] = robot.nominal[:, FRICTION]
    return phi


def most_probable(problem: LinearProblem) -> FloatArray:
    """Parameters (P,) that are most probable by data and nominal values, with the noise that the data themselves show.

    The prior is that of `PRIOR_DEVIATION`; MacKay, Bayesian Interpolation, 1992, with the prior's width known.
    """
    unit = problem.scale[problem.free] * PRIOR_DEVIATION
    A, b = problem.A[:, problem.free] * unit, problem.b - problem.A @ problem.nominal
    information, x = A.T @ A, np.zeros(len(unit))
    for _ in range(_PASSES):
        left = A @ x - b
        variance = problem.oversampling * (left @ left + problem.residual) / max(problem.rows, 1)
        x = np.linalg.lstsq(information + variance * np.eye(len(unit)), A.T @ b, rcond=None)[0]
    out = problem.nominal.copy()
    out[problem.free] += unit * x
    return out
