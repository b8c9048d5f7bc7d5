"""`torchid replay`: the torques of a log on the robot in MuJoCo, with the URDF's and with identified parameters."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.progress import Progress

from torchid import parameters
from torchid.commands.evaluate import FittedRun, read_run, require_run
from torchid.commands.folder import REPLAY, check_free, new_folder, write_json
from torchid.config import FootConfig
from torchid.errors import ConfigError, LogError, TorchidWarning, about_file, during, excerpt
from torchid.estimators.posterior import PRIOR_ERROR
from torchid.fitting.fit import Comparison
from torchid.fitting.posterior import PosteriorSampler, read_posterior
from torchid.logs.time_range import split_range
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import Samples
from torchid.problem.extras import ACTUATORS
from torchid.reading.log_reader import LogReader
from torchid.report import FittedJoints, identified_name, identified_robot
from torchid.report.figure_style import save_figures
from torchid.report.figures import drift_figure
from torchid.report.tables import progress_bars
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.robot.tree import matching_joints
from torchid.robot.urdf import read_urdf
from torchid.sensing import Contact
from torchid.simulation.plant import Foot, JointConstraints, find_feet, point_foot
from torchid.simulation.replay import Drift, Model, ReplayedLog, replay_log

_ByJoint = Mapping[str, Mapping[str, float]]
_TIMES = 25  # at which the drift is compared, within a window
PARAMETER_SAMPLES = 10
"""Robots that are drawn from what the logs leave open, where no number is given."""
_MOST_SAMPLES = 1000


@dataclass(frozen=True, kw_only=True)
class Replay:
    """How far robots drift from a log that their joints' torques are taken from.

    Attributes:
        source: name of the log.
        window: of the log that is replayed at a time [s].
        windows: number of them.
        drift: with the robot's file, which has no offsets and, a URDF, no armature, and with what was identified.
        joint_names: of the robot.
        units: of the joints' positions, "rad" or "m".
        of: what the robot's file is, "URDF" or "MJCF".
        gains: kp and kd of each joint, (2, n), 0 where the log's torques drive it alone.
        sampled: drift with each of some robots that were drawn from what the logs of the run leave open.
        output: the folder that it was written to, if any.
    """

    source: str
    window: float
    windows: int
    drift: Comparison[Drift]
    joint_names: tuple[str, ...]
    units: tuple[str, ...]
    of: str
    gains: Array
    sampled: tuple[Drift, ...] = ()
    output: Path | None = None

    __repr__ = short_repr

    def _headline(self) -> str:
        texts = [f"{name} {before:.3g} -> {after:.3g}" for name, (before, after) in self.at(self.window).items()]
        return f"{self.source}, drift after {self.window:g} s, {self.of} -> identified: {'; '.join(texts)}"

    @property
    def driven(self) -> str:
        """By what the robots are driven, in words."""
        return f"the {'PD targets' if self.gains.any() else 'torques'} of {self.source}"

    def quartiles(self) -> dict[str, Comparison[Array]]:
        """Quartiles over windows of the drift, (3, T), by what drifts and its unit.

        Of joints it is the root mean square over them. A robot that has fallen over is far off, but no farther matters.
        """
        nominal, identified = (self._quartiles_of(drift) for drift in self.drift)
        return {name: Comparison(nominal[name], identified[name]) for name in nominal}

    def _quartiles_of(self, drift: Drift) -> dict[str, Array]:
        out = {}
        for unit in dict.fromkeys(self.units):
            out[f"joints [{unit}]"] = _quartiles(drift.of_joints(np.flatnonzero(np.array(self.units) == unit)))
        if drift.tilt is not None:
            out["base tilt [rad]"] = _quartiles(drift.tilt)
        return out

    def ranges(self) -> dict[str, Array]:
        """Least and largest median drift of the robots that were drawn, (2, T), by what drifts; empty without any."""
        medians = [{name: x[1] for name, x in self._quartiles_of(drift).items()} for drift in self.sampled]
        each = {name: np.stack([median[name] for median in medians]) for name in (medians[0] if medians else ())}
        return {name: np.stack([x.min(axis=0), x.max(axis=0)]) for name, x in each.items()}

    def at(self, time: float) -> dict[str, Comparison[float]]:
        """Median drift at the compared time that is nearest to one since the beginning of a window [s]."""
        k = self._nearest(time)
        return {name: Comparison(*(float(x[1, k]) for x in pair)) for name, pair in self.quartiles().items()}

    def ranges_at(self, time: float) -> dict[str, tuple[float, float]]:
        """As `at`, of `ranges`."""
        k = self._nearest(time)
        return {name: (float(low[k]), float(high[k])) for name, (low, high) in self.ranges().items()}

    def _nearest(self, time: float) -> int:
        return int(np.abs(self.drift.nominal.time - time).argmin())

    def by_joint(self) -> dict[str, Comparison[float]]:
        """Median drift at the end of the windows, by joint."""
        each = [_quartiles(np.abs(drift.joints[:, -1]))[1].tolist() for drift in self.drift]
        return {name: Comparison(*pair) for name, *pair in zip(self.joint_names, *each, strict=True)}

    def to_dict(self) -> dict[str, object]:
        """What `replay.json` has."""
        return {
            "log": self.source,
            "window_s": self.window,
            "windows": self.windows,
            "kp": dict(zip(self.joint_names, self.gains[0].tolist(), strict=True)),
            "kd": dict(zip(self.joint_names, self.gains[1].tolist(), strict=True)),
            "time_s": self.drift.nominal.time.tolist(),
            "quartiles": {
                name: {"nominal": pair.nominal.tolist(), "identified": pair.identified.tolist()}
                for name, pair in self.quartiles().items()
            },
            "by_joint": {name: pair._asdict() for name, pair in self.by_joint().items()},
            "samples": {
                "count": len(self.sampled),
                "least_and_largest_median": {name: x.tolist() for name, x in self.ranges().items()},
            },
        }


@one_thread()
def replay(
    run: str | Path,
    log: str | Path,
    window: float = 0.5,
    output: str | Path | None = None,
    overwrite: bool = False,
    kp: float | Mapping[str, float] = 0.0,
    kd: float | Mapping[str, float] = 0.0,
    samples: int = PARAMETER_SAMPLES,
) -> Replay:
    """Drive the robot in MuJoCo with the torques of a log, and see how far it drifts from the log.

    The log is preprocessed as the run's own were. In each of its windows the robot begins in the log's state. A
    floating base stands on a level floor with the run's contacts.

    Args:
        run: folder that `identify` wrote.
        log: a log file, or a part of it (`walk.npz[30:]`).
        window: length of the windows [s].
        output: folder to write; None: nothing is.
        overwrite: whether a replay that stands there may be replaced.
        kp: gain of a PD law whose targets made the log's torques [N m/rad or N/m], of all joints or by name or pattern.
        kd: its gain on the velocity [N m s/rad or N s/m], likewise.
        samples: robots that are drawn from what the logs of the run leave open, as by `sample`, and replayed as well.

    Raises:
        InputError: the folder is no run, MuJoCo is not installed or refuses the robot, or the log lacks fields.
    """
    _require_accepted(window, samples)
    folder = Path(run)
    out = None if output is None else Path(output)
    require_run(folder)
    if out is not None:
        check_free(out, overwrite, REPLAY, [folder, *(file.path for file in split_range(log).files)])
    with progress_bars() as bars:
        fitted = read_run(folder)
        _require_simple(fitted, folder)
        robot = fitted.experiment.robot
        gains = np.stack([_joint_gains(robot, *x) for x in (("--kp", kp), ("--kd", kd))])
        reading = bars.add_task("reading the log", total=1)
        (bound,) = LogReader(fitted.experiment, folder).read([Path(log)], None, lambda _: bars.advance(reading))
        windows, drift, sampled = _drifts(fitted, folder, bound, window, gains, samples, bars)
    replayed = Replay(
        source=split_range(log).name,
        window=float(window),
        windows=windows,
        drift=drift,
        joint_names=robot.joint_names,
        units=tuple("m" if name in robot.sliding else "rad" for name in robot.joint_names),
        of=robot.format,
        gains=gains,
        sampled=sampled,
        output=out,
    )
    if out is not None:
        _write(replayed, out, overwrite, fitted.experiment.config.figures.format)
    return replayed


def _require_accepted(window: float, samples: int) -> None:
    if not 0.0 < window < np.inf:
        raise ConfigError("command line", "--window", f"{window:g}", "a time greater than 0 [s]")
    if not 0 <= samples <= _MOST_SAMPLES:
        raise ConfigError("command line", "--samples", f"{samples}", f"0 to {_MOST_SAMPLES}")


def _drifts(
    fitted: FittedRun, run: Path, bound: Samples, window: float, gains: Array, count: int, bars: Progress
) -> tuple[int, Comparison[Drift], tuple[Drift, ...]]:
    """Number of windows [s] of a log, drift of the robot's file and of the identified one, and of some draws."""
    robot = fitted.experiment.robot
    logs, models = _replayed_pairs(fitted, bound, run)
    windows = logs.nominal.windows(window)
    bar = bars.add_task("replaying", total=(2 + count) * len(windows))
    feet = _feet(fitted.experiment.contacts, robot.path) if not robot.fixed_base else ()
    conditions = feet, windows, window * np.arange(1, _TIMES + 1) / _TIMES, lambda n: bars.advance(bar, n), gains
    drift = Comparison(*(replay_log(model, log, *conditions) for model, log in zip(models, logs, strict=True)))
    return (
        len(windows),
        drift,
        tuple(replay_log(model, logs.identified, *conditions) for model in _drawn(fitted, run, count)),
    )


def _replayed_pairs(
    fitted: FittedRun, samples: Samples, folder: Path
) -> tuple[Comparison[ReplayedLog], Comparison[Model]]:
    """What drives the robot of its file and the identified one, and both."""
    robot = fitted.experiment.robot
    calibration = fitted.calibrations.identified
    logs = Comparison(*(_replayed(log) for log in (samples, *calibration.calibrate([samples]))))
    joints: dict[str, dict[str, float]] = {what: {} for what in ACTUATORS}
    for extra, value in calibration.of_joints:
        joints[extra.what][extra.name] = value
    fitted_joints = joints, calibration.phi.reshape(robot.nominal.shape), calibration.builder.tree.stribeck
    identified = _model(folder / identified_name(robot), robot, *fitted_joints)
    return logs, Comparison(_model(robot.path, robot, {}, None), identified)


def _drawn(fitted: FittedRun, run: Path, count: int) -> Iterator[Model]:
    """Robots drawn from the posterior of a run, always the same ones."""
    if not count:
        return
    robot = fitted.experiment.robot
    stribeck = fitted.experiment.terms.stribeck
    posterior = read_posterior(run)
    sampler = PosteriorSampler(posterior, posterior.prior_error(PRIOR_ERROR))
    samples = sampler.sample(count, torch.Generator().manual_seed(0))
    of_joints = {what: samples.of_joints(what) for what in ACTUATORS}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # said of the identified robot, when it was written
        for number, phi in enumerate(samples.phi.numpy()):
            joints = {
                what: {name: float(x[number]) for name, x in values.items()} for what, values in of_joints.items()
            }
            file = Path(folder) / identified_name(robot)
            in_file = FittedJoints(joints["armature"], joints["stiffness"], joints["torque_offset"])
            file.write_bytes(identified_robot(robot, phi, in_file))
            yield _model(file, robot, joints, phi, stribeck)


_GAIN = "numbers of at least 0, one for all joints or by pattern: 20 '*_calf=30'"


def parse_gains(option: str, entries: Sequence[str]) -> dict[str, float]:
    """Gains by joint or pattern, of words like 20 and *_calf=30. Raises ConfigError: a word that is neither."""
    gains = {}
    for entry in entries:
        name, _, number = entry.rpartition("=")
        try:
            gains[name or "*"] = float(number)
        except ValueError as error:
            raise ConfigError("command line", option, f"'{excerpt(entry)}'", _GAIN) from error
    return gains


def _joint_gains(robot: Robot, option: str, stated: float | Mapping[str, float]) -> Array:
    """A gain of each joint, (n,), from one of all or by name or pattern; later patterns count, others have 0.

    Raises:
        UnknownNameError: a joint that does not exist.
        ConfigError: a pattern that matches none, or a gain that is negative.
    """
    out = np.zeros(robot.n)
    by_name = stated if isinstance(stated, Mapping) else {"*": stated}
    for key, gain in by_name.items():
        if not 0.0 <= gain < np.inf:
            raise ConfigError("command line", option, f"{gain:g}", _GAIN)
        out[[robot.joint_names.index(name) for name in matching_joints(option, key, robot.joint_names)]] = gain
    return out


def _write(replayed: Replay, out: Path, overwrite: bool, form: str) -> None:
    """Write all numbers and the figure of a replay, in a format, to a folder."""
    figure = drift_figure(
        replayed.driven,
        replayed.drift.nominal.time,
        replayed.quartiles(),
        replayed.ranges(),
        replayed.by_joint(),
        replayed.units,
        replayed.of,
    )
    with during("writing", out), new_folder(out, overwrite, REPLAY) as folder:
        write_json(folder / "replay.json", replayed.to_dict())
        save_figures({"drift": figure}, folder, form)


def _require_simple(fitted: FittedRun, run: Path) -> None:
    """Make sure that MuJoCo can move the robot as the run understands it. Raises ConfigError: it cannot."""
    robot = fitted.experiment.robot
    root = next(name for name, (body, pose) in robot.links.items() if body == 0 and np.array_equal(pose, np.eye(4)))
    if not robot.fixed_base and robot.base_link != root:
        accepted = f"the {robot.format}'s root, '{root}', to replay"
        with about_file(run / "config.yaml"):
            raise ConfigError.at_field("robot.base_link", f"'{robot.base_link}'", accepted)


def _quartiles(drift: Array) -> Array:
    """Over windows, of what is off in each of them, (W, ...); infinitely, where a simulation has diverged."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.quantile(np.nan_to_num(drift, nan=np.inf), (0.25, 0.5, 0.75), axis=0, method="nearest"))


def _model(urdf: Path, robot: Robot, fitted: _ByJoint, phi: Array | None, stribeck: float | None = None) -> Model:
    """The robot of a file with armatures, springs and offsets of torque by joint, and those of the file elsewhere.

    Coulomb friction that differs by direction is symmetric friction and an offset, as far as the joint moves.

    Args:
        urdf: the file.
        robot: of it.
        fitted: values of `ACTUATORS`, by joint.
        phi: (L, 12), identified parameters; None for the robot's file itself.
        stribeck: velocity of Stribeck friction [rad/s or m/s], None without.
    """
    values = {what: np.zeros(robot.n) for what in ACTUATORS}
    values |= {"armature": robot.armature.copy(), "stiffness": robot.stiffness.copy()}
    for what, by_joint in fitted.items():
        for name, value in by_joint.items():
            values[what][robot.joint_names.index(name)] = value
    offset = values["torque_offset"] + values["asymmetric_coulomb"] + robot.spring_torque
    constraints = JointConstraints.of(urdf, read_urdf(urdf)[1], robot.loops, robot.welded)
    if phi is not None and robot.welded:
        constraints = replace(constraints, inertials=_inertials_beyond_welds(robot, phi))
    at_rest = values["stribeck"], stribeck or np.inf
    return Model(urdf, robot.joint_names, values["armature"], offset, values["stiffness"], constraints, *at_rest)


def _inertials_beyond_welds(robot: Robot, phi: Array) -> dict[str, Array]:
    """Inertial parameters (10,) of links that welds join to one body: all of it at the link that names the body.

    What a run's file has of these links is the URDF's, and what is left: together a body that can exist.
    """
    numbers = {robot.links[link][0] for link in robot.links_beyond_welds}
    out = {link: np.zeros(parameters.INERTIAL.stop) for k in numbers for link in robot.bodies[k].links}
    return out | {robot.bodies[k].name: phi[k, parameters.INERTIAL] for k in numbers}


def _replayed(samples: Samples) -> ReplayedLog:
    """What is replayed of a log.

    Raises:
        LogError: it has no joint torques, or a floating base whose orientation was not recorded.
    """
    base = samples.base
    if samples.torque is None or not np.isfinite(samples.torque.numpy()).all():
        raise LogError(samples.source, "joint_torque", "missing for some joints", "a log with all joint torques")
    floating = base.angular_velocity is not None
    if floating and base.quat_xyzw is None:
        raise LogError(samples.source, "base", "no orientation", "base_quat_wxyz or base_quat_xyzw, to replay it")
    return ReplayedLog(
        source=samples.source,
        time=samples.time.numpy(),
        position=samples.joint_position.numpy(),
        velocity=samples.joint_velocity.numpy(),
        torque=samples.torque.numpy(),
        quat_xyzw=None if base.quat_xyzw is None else base.quat_xyzw.numpy(),
        angular_velocity=None if base.angular_velocity is None else base.angular_velocity.numpy(),
        active=samples.active.numpy(),
    )


def _feet(contacts: Sequence[Contact], urdf: Path) -> tuple[Foot, ...]:
    """Contacts of a run as they touch a floor: spheres of their radius, or of the URDF's collision shapes.

    Raises:
        InputError: a flat contact without collision spheres.
    """
    feet = []
    for contact in contacts:
        if contact.kind == "point":
            feet.append(point_foot(contact.frame, contact.radius, contact.centre))
            continue
        try:
            feet += find_feet([FootConfig(frame=contact.frame)], urdf)
        except ConfigError as error:
            reason = f"{contact.frame} is a {contact.kind} contact, but {urdf.name} has no collision spheres there"
            accepted = f"point contacts, or collision spheres of the link {contact.frame}"
            raise ConfigError.at_field("contacts", reason, accepted) from error
    return tuple(feet)
