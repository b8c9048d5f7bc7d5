"""Measured forces compared with those of the URDF's parameters, on some samples of a log."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchid.errors import TorchidWarning
from torchid.log_checks.findings import median_step
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import preprocess
from torchid.problem import RowBuilder, Samples, bind_log
from torchid.problem.predict import force_series, null_space_part
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet, named_sensors

#: Samples that are differentiated: all of a short log, `PIECES` evenly spread runs of a long one.
DIFFERENTIATED, PIECES = 40000, 4
#: Of these, evenly spread ones are compared; fewer to find which of many mistakes explains a misfit.
COMPARED, TRIED = 800, 150
#: Of a long log, as many samples are differentiated to try a mistake.
DIFFERENTIATED_TO_TRY = 10000
#: Default cutoff [Hz]: robots move below 5 Hz. At most this share of the sample rate.
CUTOFF, _OF_RATE = 10.0, 0.2
#: How much larger a torque's own part in the projected forces must be than what the model leaves of these, for its sign
#: to be judged.
CLEAR = 1.0
#: A torque this many times larger or smaller than needed is no error of the model: friction that the URDF lacks makes
#: up a factor of several, a gear 50 to 160.
SCALE = 10.0
#: As `CLEAR` for each joint's own row, where contact wrenches are known or there are none: a correlation of 0.9.
CLEAR_ROW = 2.0
#: Misfit of the base force from which on contact wrenches are not used to determine the sign of a torque.
_TRUSTED = 0.3
#: A torque [N m] that no sensor reads.
NOTHING = 1e-9
#: Singular values below this share of the largest count as that large: the data do not determine such combinations.
_DEPENDENT, _TINY = 1e-12, 1e-100


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Factors of joint torques that fit the URDF best.

    Attributes:
        joints: numbers of the m joints whose torque was measured.
        gain: (m,) factor that each should be multiplied by.
        clear: (m,) bool, whether the data determine the gain.
        misfit: size of what the torques as they are miss of the model's, over the size of the model's.
        misfit_corrected: as `misfit`, with torques multiplied by their gain where that is clear and not plausible.
    """

    joints: np.ndarray
    gain: FloatArray
    clear: BoolArray
    misfit: float
    misfit_corrected: float

    @property
    def wrong(self) -> BoolArray:
        """Joints (m,) whose torque is clearly reversed or of another size."""
        return _wrong_gains(self.gain, self.clear)


@dataclass(frozen=True, eq=False)
class ModelFit:
    """How well measured forces agree with the URDF: torques, and what contact wrenches do to the base, if measured.

    `base_force` and `base_moment`: size of the difference over the size of the model's.
    """

    torque: TorqueFit | None
    base_force: float | None
    base_moment: float | None

    @property
    def of_torques(self) -> float | None:
        """Misfit of the torques: single ones that are clearly wrong do not count, all of them do."""
        fit = self.torque
        if fit is None:
            return None
        return fit.misfit if fit.wrong.sum() >= fit.clear.sum() else fit.misfit_corrected

    @property
    def of_wrenches(self) -> float | None:
        """The larger misfit of what the contact wrenches do to the base."""
        return max((part for part in (self.base_force, self.base_moment) if part is not None), default=None)

    @property
    def known(self) -> tuple[bool, ...]:
        """Which of torques, base force and base moment could be compared."""
        return tuple(part is not None for part in (self.torque, self.base_force, self.base_moment))

    @property
    def misfit(self) -> float:
        """Rms of all that there are."""
        known = [x for x in (self.of_torques, self.base_force, self.base_moment) if x is not None]
        return float(np.sqrt(np.mean(np.square(known)))) if known else 0.0


def _wrong_gains(gain: FloatArray, clear: BoolArray) -> BoolArray:
    """Which gains (m,) no error of a model can be, among those that are clear."""
    return clear & ((gain < 0.0) | (np.abs(np.log(np.maximum(np.abs(gain), _TINY))) > np.log(SCALE)))


def default_cutoff_hz(log: Log) -> float:
    """The cutoff [Hz] for a log where none is given."""
    return min(CUTOFF, _OF_RATE / median_step(log))


def preprocess_pieces(log: Log, cutoff_hz: float, most: int = DIFFERENTIATED) -> list[Log]:
    """The log with velocities and accelerations; of one longer than `most`, runs of samples from all over it.

    Raises:
        InputError: the log cannot be filtered.
    """
    count = 1 if len(log) <= most else PIECES
    length = min(len(log), most) // count
    starts = np.linspace(0, len(log) - length, count).astype(int)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # findings report the same
        return [preprocess(log.select(slice(start, start + length)), cutoff_hz) for start in starts]


def bind_some_samples(
    logs: Sequence[Log], robot: Robot, contacts: Sequence[Contact], count: int = COMPARED
) -> list[Samples]:
    """About `count` evenly spread samples of filtered logs.

    Raises:
        InputError: they do not fit the robot.
    """
    out = []
    for log in logs:
        samples = bind_log(log, robot, contacts)
        out.append(samples[torch.linspace(0, len(samples) - 1, min(count // len(logs), len(samples))).long()])
    return out


def link_poses(log: Log, robot: Robot) -> dict[str, torch.Tensor]:
    """Poses (N, 4, 4) in the base of the robot's links, by name, at the samples of a log of all its joints."""
    order = [log.joint_names.index(name) for name in robot.joint_names]
    return robot.link_poses(torch.from_numpy(log.joint_position[:, order]))


def fit_nominal_model(samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]) -> ModelFit:
    """Compare the forces of some samples with those of the URDF."""
    measured = np.zeros(robot.n, dtype=bool)
    if all(part.torque is not None for part in samples):
        torque = np.concatenate([part.torque[:, : robot.n].numpy() for part in samples if part.torque is not None])
        measured = np.isfinite(torque).all(axis=0) & (np.abs(torque) > NOTHING).any(axis=0)
    builder = RowBuilder(robot, contacts, _joints_only(robot, contacts, measured))
    forces = [force_series(builder, part, robot.nominal.flatten()[None]) for part in samples]
    acting, needed = np.concatenate([f[0] for f in forces]), np.concatenate([f[1][0] for f in forces])
    base = robot.base_rows
    found = [_relative(acting[:, rows], needed[:, rows]) for rows in (slice(0, min(3, base)), slice(3, base))]
    fit = None
    if measured.any():
        joints = np.flatnonzero(measured)
        fit = _projected_fit(builder, samples, needed, torque, joints)
        contact_part = acting[:, base : base + robot.n] - torque
        trusted = not contacts or (found[0] is not None and found[0] < _TRUSTED and np.isfinite(contact_part).all())
        if trusted and not fit.clear.all():
            fit = _with_wrenches(fit, needed[:, base : base + robot.n] - contact_part, torque)
    return ModelFit(fit, *found)


def _joints_only(robot: Robot, contacts: Sequence[Contact], measured: BoolArray) -> SensorSet:
    every = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
    mask = np.array(every.torque)
    mask[: robot.n] = measured
    return dataclasses.replace(every, torque=mask)


def _relative(found: FloatArray, wanted: FloatArray) -> float | None:
    """Size of the difference over that of `wanted`, over samples where `found` is known; None where it never is."""
    known = np.isfinite(found).all(axis=1)
    size = np.linalg.norm(wanted[known])
    if not found.shape[1] or not known.any() or not size > 0.0 or not found[known].any():
        return None
    return float(np.linalg.norm(found[known] - wanted[known]) / size)


def _projected_fit(
    builder: RowBuilder, samples: Sequence[Samples], needed: FloatArray, torque: FloatArray, joints: np.ndarray
) -> TorqueFit:
    """Gains by least squares in the contacts' null space, where no contact force counts."""
    base = builder.tree.base_rows
    rows = [*range(base), *(base + joints)]
    vectors = np.zeros((1 + len(joints), *needed.shape))
    vectors[0] = needed
    for index, joint in enumerate(joints):
        vectors[1 + index, :, base + joint] = torque[:, joint]
    ends = np.cumsum([len(part) for part in samples])[:-1]
    parts = np.split(vectors, ends, axis=1)
    inside = np.concatenate([null_space_part(builder, s, v) for s, v in zip(samples, parts, strict=True)], axis=1)
    inside = inside[..., rows].reshape(1 + len(joints), -1)
    y, A = inside[0], inside[1:].T
    norms = np.linalg.norm(A, axis=0)
    norms[norms == 0.0] = 1.0
    U, values, Vh = np.linalg.svd(A / norms, full_matrices=False)
    inverse = Vh.T / np.maximum(values, max(_DEPENDENT * values.max(initial=0.0), _TINY))
    gain = inverse @ (U.T @ y) / norms
    own = norms / np.sqrt(np.square(inverse).sum(axis=1))  # what of each torque the others cannot make up for
    clear = own * np.abs(gain) > CLEAR * np.linalg.norm(y - A @ gain)
    corrected = np.where(_wrong_gains(gain, clear), gain, 1.0)
    size = max(float(np.linalg.norm(y)), _TINY)
    missed = (float(np.linalg.norm(y - A @ factor)) / size for factor in (np.ones(len(joints)), corrected))
    return TorqueFit(joints, gain, clear, *missed)


def _with_wrenches(fit: TorqueFit, needed: FloatArray, torque: FloatArray) -> TorqueFit:
    """The fit with gains that all rows together leave open from each joint's own row, the contacts' part taken off."""
    gain, clear = fit.gain.copy(), fit.clear.copy()
    for index in np.flatnonzero(~clear):
        want, have = needed[:, fit.joints[index]], torque[:, fit.joints[index]]
        gain[index] = want @ have / (have @ have)
        left = np.linalg.norm(want - gain[index] * have)
        clear[index] = abs(gain[index]) * np.linalg.norm(have) > CLEAR_ROW * left
    return dataclasses.replace(fit, gain=gain, clear=clear)
