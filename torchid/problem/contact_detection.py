"""Which contacts stand when, from joint torques and the robot's own dynamics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from torchid.logs import Log
from torchid.logs.flags import beside_changes, hysteresis, samples_of, without_short
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import find_unloaded
from torchid.problem.contact_slip import base_velocity, contact_velocities, keep_still
from torchid.problem.detection_forces import ForcesAlongNormals, fitted_parameters
from torchid.problem.detection_motion import DetectionSamples, detection_cutoff_hz, nyquist_hz, prepare
from torchid.problem.samples import require_contacts
from torchid.robot import Robot
from torchid.rounding import STD_PER_MAD
from torchid.sensing import Contact
from torchid.settings import STRICT, NotNegative, Positive

_SUPPORTED = 0.25  # of the weight: what contact forces may leave of it in samples that parameters are fitted to
_LEAST_FITTED = 100  # samples
_DEVIATIONS = 3.0  # of what feet seem to carry in the air, to which thresholds go down
_LOWEST = 0.01  # of the stated thresholds
_FITS, _LESS = 3, 0.9  # of parameters at most, each of which leaves that share of what feet seem to carry in the air


@dataclass(config=STRICT, frozen=True)
class DetectionConfig:
    """How contacts are detected.

    A contact stands from where its normal force exceeds `touch` until it is below `lift`, shares of the robot's
    weight by the URDF. Where the base's motion was measured, it stands also while it carries more than `light` and
    keeps still, for twice `shortest_s` at least. Torques are low-pass filtered before (`cutoff_hz`, zero phase);
    stances and swings shorter than `shortest_s` [s] are none. Samples within `margin_s` [s] of a change are dropped, as
    are those within `preprocessing.contact_margin_s`. Contacts of which it is not certain that they are in the air
    count as standing in all others: a force that may be zero costs a few equations, one that is ignored biases a fit.

    With `refit`, where the base's acceleration is known, parameters are then fitted to each log with the contacts that
    were found, and contacts detected again with these: by thresholds that are lower in the same ratio, three standard
    deviations of what feet seem to carry in the air, and with a wider filter, at last none, as long as these leave
    `touch` as it is; then samples about touches by `touch` that are too short for a stance are dropped as well.
    Of what that filter leaves, parameters are fitted again as long as feet seem to carry less in the air for it.
    A contact that stands by either counts as standing, and samples about changes by the stated ones are dropped.
    """

    touch: Positive = 0.02
    lift: NotNegative = 0.015
    light: NotNegative = 0.005
    cutoff_hz: Positive = 20.0
    shortest_s: NotNegative = 0.04
    margin_s: NotNegative = 0.02
    refit: bool = True


def with_detected_contacts(
    log: Log,
    robot: Robot,
    contacts: Sequence[Contact],
    settings: DetectionConfig | None = None,
    possible: bool = False,
    sign_width: float | None = None,
) -> tuple[Log, BoolArray]:
    """The log with flags of all contacts by `detect_contacts` in the place of what it has, and where they are certain.

    Args:
        log: as recorded.
        robot: the robot.
        contacts: that may stand.
        settings: thresholds.
        possible: as of `Detection.flags`.
        sign_width: as of `detect_contacts`.

    Raises:
        LogError: as `detect_contacts`; wrenches without the name of a contact.
    """
    active, certain = detect_contacts(log, robot, contacts, settings or DetectionConfig(), sign_width).flags(possible)
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
    require_contacts(source, names, contacts)
    flags = np.zeros((len(active), len(names)), dtype=bool)
    flags[:, [names.index(frame) for frame in frames]] = active
    return names, flags


class Detection(NamedTuple):
    """Which contacts stand.

    Attributes:
        active: (N, C).
        certain: samples (N,) whose `active` a fit may trust: neither those at both ends of a log, which the filter
            spoils, nor those beside changes, nor stances that were too short to count.
        possible: (N, C), `active` and contacts that may carry something all the same.
        clear: samples (N,) without ends and changes, by the stated thresholds, in which no other contact carries any.
    """

    active: BoolArray
    certain: BoolArray
    possible: BoolArray
    clear: BoolArray

    def flags(self, possible: bool) -> tuple[BoolArray, BoolArray]:
        """Flags (N, C), and samples (N,) that a fit may trust them in: of contacts that stand, or of possible ones.

        A contact that may stand is none to work a pose out of. Of unknown forces it may have one: nothing but the
        equations that it takes is lost where that is zero.
        """
        return (self.possible, self.clear) if possible else (self.active, self.certain)


def detect_contacts(
    log: Log, robot: Robot, contacts: Sequence[Contact], settings: DetectionConfig, sign_width: float | None = None
) -> Detection:
    """Which contacts stand when.

    Args:
        log: as recorded, with the torques of all joints above the contacts.
        robot: the robot, whose base floats.
        contacts: that may stand.
        settings: thresholds.
        sign_width: over which the sign of friction changes, as of `KinematicTree` [rad/s or m/s]; narrow by default.

    Raises:
        LogError: no torques, fewer than three of joints above a contact, or joints that are missing.
        InputError: a cutoff that does not suit the log.
    """
    if not contacts:
        none, every = np.zeros((len(log), 0), dtype=bool), np.ones(len(log), dtype=bool)
        return Detection(none, every, none, every)

    filtered = partial(prepare, log, robot, contacts)
    known = filtered(detection_cutoff_hz(settings.cutoff_hz, log.time))
    forces = ForcesAlongNormals.of(known, robot, contacts, sign_width)
    seen = _Seen.of(known, forces, settings)
    found, time = seen.judged(), seen.time
    if settings.refit and seen.accelerates:
        found, time = _detect_again(filtered, forces, seen, found)
    inside = (log.time >= time[0]) & (log.time <= time[-1])
    nearest = _nearest(time, log.time)
    active, certain, possible, clear = (part[nearest] for part in found)
    return Detection(active, inside & certain, possible, inside & clear)


def _nearest(time: FloatArray, stamps: FloatArray) -> NDArray[np.intp]:
    """Which of times (K,) in order is the nearest to each stamp (N,)."""
    return np.searchsorted(0.5 * (time[1:] + time[:-1]), stamps)


@dataclasses.dataclass(frozen=True)
class _Seen:
    """What filtered signals say of contacts.

    Attributes:
        known: the signals.
        share: of the weight that contacts carry, (K, C).
        velocity: (K, C, 3) [m/s], in the world or not; None where it is unknown.
        in_world: whether it is.
        settings: thresholds.
    """

    known: DetectionSamples
    share: FloatArray
    velocity: FloatArray | None
    in_world: bool
    settings: DetectionConfig

    @classmethod
    def of(cls, known: DetectionSamples, forces: ForcesAlongNormals, settings: DetectionConfig) -> _Seen:
        """What the signals say with these forces."""
        balance, base = forces.balance, base_velocity(known.log, known.samples)
        velocity = None
        if known.base_is_known:
            velocity = contact_velocities(known.samples, balance.robot, balance.contacts, base)
        return cls(known, forces.of_samples(known) / balance.weight, velocity, base is not None, settings)

    @property
    def accelerates(self) -> bool:
        """Whether the acceleration of the base is known."""
        return self.known.base_is_known and self.known.acceleration_is_known

    @property
    def time(self) -> FloatArray:
        """Stamps (K,) [s]."""
        return self.known.log.time

    @property
    def smear_s(self) -> float:
        """How far [s] from a change of contact its filtered force is seen."""
        return 1.0 / self.known.cutoff_hz

    def judged(self, bounces: bool = False) -> Detection:
        """Which contacts stand; with bounces, no stance is too short to have impacts."""
        settings, shortest = self.settings, samples_of(self.settings.shortest_s, self.time)
        loaded = np.stack([hysteresis(one, settings.touch, settings.lift) for one in self.share.T], axis=1)
        if self.velocity is not None:
            loaded |= keep_still(self.velocity, self.in_world, loaded, self.share > settings.light, 2 * shortest)
        flags = np.stack([without_short(one, shortest) for one in loaded.T], axis=1)
        pulls = np.stack([hysteresis(-one, settings.touch, settings.lift) for one in self.share.T], axis=1)
        clear, possible = ~beside_changes(loaded if bounces else flags), flags | loaded | pulls
        return Detection(flags, clear & ~(possible & ~flags).any(axis=1), possible, clear)

    def noise(self, in_the_air: BoolArray) -> float:
        """Standard deviation of the share that contacts seem to carry in the air (K, C); infinite of few samples."""
        if in_the_air.sum() < _LEAST_FITTED:
            return np.inf
        return STD_PER_MAD * float(np.median(np.abs(self.share[in_the_air])))

    def finer(self, in_the_air: BoolArray, is_sharp: bool) -> Detection:
        """As `judged`, with thresholds as low as the shares of contacts in the air (K, C) allow.

        Certain is what the settings' own thresholds say too: they differ from before a foot touches until it carries
        something, with an impact between. Of sharp signals feet that scuff the floor are not certain either, and have
        impacts where they carry enough; elsewhere noise would pass for them. In the air is what stands by neither,
        twice as far away as the filter lets a scuff be seen: once around, a touch that is too light to be seen at its
        beginning is left in the air.
        """
        found = self.judged(bounces=is_sharp)
        factor = float(np.clip(_DEVIATIONS * self.noise(in_the_air) / self.settings.touch, _LOWEST, 1.0))
        lower = {name: factor * getattr(self.settings, name) for name in ("touch", "lift", "light")}
        finer = dataclasses.replace(self, settings=dataclasses.replace(self.settings, **lower)).judged()
        certain = found.certain & finer.clear & (finer.active == found.active).all(axis=1)
        possible = found.possible | finer.active
        if is_sharp:
            certain &= finer.certain
            possible = ~find_unloaded(self.time, possible | finer.possible, 2.0 * self.smear_s)
        return Detection(finer.active, certain, possible, found.clear)


def _detect_again(
    filtered: Callable[[float], DetectionSamples], forces: ForcesAlongNormals, seen: _Seen, found: Detection
) -> tuple[Detection, FloatArray]:
    """Contacts by parameters that fit the log, and the stamps (K,) [s] of the samples in which they are known.

    Where a wider filter serves, parameters are fitted again to what it leaves, with all contacts that it shows, for as
    long as feet seem to carry less in the air for it.

    Args:
        filtered: the log at a cutoff.
        forces: by the URDF.
        seen: with these, at the cutoff of the settings.
        found: which contacts stand by these.
    """
    time, sharp = seen.time, seen.known
    lowest: float | None = None
    air, ground = (find_unloaded(time, active, seen.smear_s) for active in (found.active, ~found.active))
    again = _fitted(forces, found.active, found.certain & (air | ground).all(axis=1))
    for more in reversed(range(_FITS)):
        if again is None:
            break
        best = _sharpest(filtered, sharp, again, seen, air)
        in_the_air = air[_nearest(seen.time, best.time)]
        noise = best.noise(in_the_air)
        if lowest is not None and noise > _LESS * lowest:
            break
        time, sharp, lowest = best.time, best.known, noise
        is_sharp = sharp.cutoff_hz > seen.known.cutoff_hz
        found = best.finer(in_the_air, is_sharp)
        if not is_sharp or not more:
            break
        of_robot = forces.balance.robot, forces.balance.contacts, forces.balance.builder.tree.sign_width
        by_urdf = ForcesAlongNormals.of(sharp, *of_robot)
        away = find_unloaded(time, ~found.clear[:, None], 2.0 * best.smear_s)[:, 0]
        again = _fitted(by_urdf, found.possible, away)
    return found, time


def _sharpest(
    filtered: Callable[[float], DetectionSamples],
    known: DetectionSamples,
    forces: ForcesAlongNormals,
    seen: _Seen,
    in_the_air: BoolArray,
) -> _Seen:
    """What the widest filter shows whose noise leaves the thresholds as they are, or signals without one.

    A filter of 20 Hz shows an impact 25 ms early, and a foot that scuffs the floor for 5 ms not at all.

    Args:
        filtered: the log at a cutoff.
        known: at the least of them.
        forces: with parameters that fit the log.
        seen: settings, and stamps of those in the air.
        in_the_air: contacts (K, C) that surely are.
    """
    best = _Seen.of(known, forces, seen.settings)
    highest = nyquist_hz(known.log.time)
    while best.known.cutoff_hz < highest:
        wider = _Seen.of(filtered(min(2.0 * best.known.cutoff_hz, highest)), forces, seen.settings)
        if _DEVIATIONS * wider.noise(in_the_air[_nearest(seen.time, wider.time)]) > seen.settings.touch:
            break
        best = wider
    return best


def _fitted(forces: ForcesAlongNormals, active: BoolArray, sure: BoolArray) -> ForcesAlongNormals | None:
    """The forces of the robot with parameters that fit its torques; None without enough samples.

    Of samples in which contacts carry the robot: a belly or a rope leaves a part of its weight.

    Args:
        forces: by the URDF.
        active: which contacts (K, C) stand or may do so.
        sure: samples (K,) in which no other does.
    """
    kept = np.flatnonzero(sure[forces.chosen] & (forces.unexplained < _SUPPORTED * forces.balance.weight))
    if len(kept) < _LEAST_FITTED:
        return None
    flags = torch.from_numpy(active[forces.chosen[kept]])
    samples = dataclasses.replace(forces.samples[torch.from_numpy(kept)], active=flags)
    return forces.with_parameters(*fitted_parameters(samples, forces.balance.builder, forces.balance.robot))
