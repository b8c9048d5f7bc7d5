"""The base's motion from the feet that stand: its pose, its derivatives, gaps between segments, and refusals."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from motions import value
from refusals import refused
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from stances import Stance, stance
from synthetic import Array
from walking import robot_of

from torchid.config.experiment import AnalyzeConfig
from torchid.config.logs import PreprocessingConfig
from torchid.config.robot import RobotConfig
from torchid.errors import LogError, TorchidWarning, UnknownNameError
from torchid.fitting.experiment import RobotSetup
from torchid.logs import Log
from torchid.logs.preprocess import DERIVATIVE_CHAINS, preprocess
from torchid.problem import Samples, bind_log
from torchid.problem.base_pose import LogWithPose, base_pose_from_feet
from torchid.reading.log_reader import LogReader
from torchid.robot import Robot
from torchid.sensing import Contact

LEVEL = (0.0, 0.0, 1.0)
AHEAD = (float(np.sin(0.15)), 0.0, float(np.cos(0.15)))
ASKEW = (0.1, -0.2, float(np.sqrt(0.95)))
MOTION = ("specific_force", "angular_velocity", "angular_acceleration")
EXACT, ROLLING = 1e-13, 1e-7  # the latter: how far the helper has iterated


def found(case: Stance, log: Log | None = None, contacts: tuple[Contact, ...] | None = None) -> LogWithPose:
    robot = robot_of(case.machine)
    return base_pose_from_feet(case.log if log is None else log, robot, contacts or case.contacts())


def assert_same_pose(standing: LogWithPose, case: Stance, tolerance: float, samples: slice = slice(None)) -> None:
    """The same rotation, and the same position but for where the floor's origin is."""
    quat, position = (value(getattr(standing.log, name)) for name in ("base_quat_xyzw", "base_position_world"))
    rotation = Rotation.from_quat(quat[samples]).as_matrix()
    np.testing.assert_allclose(rotation, case.rotation[samples], rtol=0.0, atol=tolerance)
    apart = position[samples] - case.position[samples]
    np.testing.assert_allclose(apart - apart[0], 0.0, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(apart @ np.array(case.normal), 0.0, rtol=0.0, atol=tolerance)


def without(log: Log, foot: int, samples: slice = slice(None)) -> Log:
    """The log with a foot's flag cleared."""
    active = value(log.contact_active).copy()
    active[samples, foot] = False
    return replace(log, contact_active=active)


# ----------------------------------------------------------------------------------------------------------------- pose


@pytest.mark.parametrize("normal", [LEVEL, AHEAD, ASKEW], ids=["level", "ahead", "askew"])
@pytest.mark.parametrize("name", ["quadruped", "humanoid", "biped"])
@pytest.mark.parametrize("lifts", [(), ((1, 50, 90),)], ids=["standing", "a foot lifted"])
def test_the_pose_above_standing_feet_is_that_of_the_base(
    name: str, normal: tuple[float, float, float], lifts: tuple[tuple[int, int, int], ...]
) -> None:
    case = stance(name, normal, 0.0, lifts)
    standing = found(case)
    assert standing.segments == (slice(0, len(case.log)),)
    assert standing.dropped == {}
    assert standing.uneven < 1e-7
    assert_same_pose(standing, case, EXACT)
    tilts = Rotation.from_matrix(case.rotation).magnitude()
    assert np.ptp(tilts) > 0.05, "a base that hardly turns shows nothing"


def test_a_foot_that_comes_down_elsewhere_must_not_count_as_where_it_was() -> None:
    case = stance("quadruped", LEVEL, 0.0, ((1, 50, 90),))
    never_lifted = replace(case.log, contact_active=np.ones_like(value(case.log.contact_active)))
    position = value(found(case, never_lifted).log.base_position_world)
    apart = position - case.position
    assert np.abs(apart - apart[0]).max() > 1e-3


@pytest.mark.parametrize("normal", [LEVEL, ASKEW], ids=["level", "askew"])
@pytest.mark.parametrize("lifts", [(), ((1, 50, 90),)], ids=["standing", "a foot lifted"])
def test_balls_roll_under_the_base(normal: tuple[float, float, float], lifts: tuple[tuple[int, int, int], ...]) -> None:
    case = stance("quadruped", normal, 0.022, lifts)
    assert_same_pose(found(case), case, ROLLING)
    points = tuple(replace(contact, radius=0.0) for contact in case.contacts())
    position = value(found(case, contacts=points).log.base_position_world)
    apart = position - case.position
    assert np.abs(apart - apart[0]).max() > 1e-3, "rolling must matter"


def test_balls_of_different_sizes_stand_on_one_floor() -> None:
    case = stance("quadruped")
    robot, radii = robot_of(case.machine), np.array([0.0, 0.01, 0.02, 0.03])
    log = case.log.select(slice(0, 1))
    contacts = tuple(replace(c, radius=float(r)) for c, r in zip(case.contacts(), radii, strict=True))
    standing = base_pose_from_feet(log, robot, contacts)
    up = Rotation.from_quat(value(standing.log.base_quat_xyzw)).inv().apply(LEVEL)[0]
    poses = robot.link_poses(torch.from_numpy(log.joint_position))
    centres = np.array([poses[c.frame][0, :3, 3].numpy() for c in contacts])
    heights = centres @ up + value(standing.log.base_position_world)[0, 2] - radii
    assert abs(heights.sum()) < 1e-12
    assert np.linalg.norm(heights) <= np.linalg.norm(_flattest(centres, radii)) + 1e-9


def _flattest(centres: Array, radii: Array) -> Array:
    """Distances of balls from the plane that least squares by another way puts below them."""

    def distances(x: Array) -> Array:
        up = np.array([x[0], x[1], 1.0]) / np.sqrt(1.0 + x[0] ** 2 + x[1] ** 2)
        return np.asarray(centres @ up - radii + x[2])

    return distances(least_squares(distances, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def test_three_point_feet_or_one_flat_foot_suffice() -> None:
    for name, foot in (("quadruped", 2), ("humanoid", 0)):
        case = stance(name)
        standing = found(case, without(case.log, foot))
        assert standing.dropped == {}
        assert_same_pose(standing, case, 1e-8)


def test_two_lines_across_each_other_suffice_and_one_does_not() -> None:
    case = stance("humanoid")
    contacts = tuple(replace(contact, kind="line", line_axis="y") for contact in case.contacts())
    apart = case.log.joint_position[:1]
    strided = replace(case.log.select(slice(0, 1)), joint_position=apart)
    up = Rotation.from_quat(value(found(case, strided, contacts).log.base_quat_xyzw)).inv().apply(LEVEL)
    np.testing.assert_allclose(up, case.rotation[:1, 2], rtol=0.0, atol=1e-8)
    refused(
        lambda: found(case, without(case.log, 0), contacts),
        "humanoid: contact_active: at most 1 contact at the same time",
        LogError,
    )


@pytest.mark.parametrize("name", ["quadruped", "humanoid"])
def test_the_recorded_order_of_joints_and_contacts_does_not_matter(name: str) -> None:
    case, rng = stance(name), np.random.default_rng(0)
    joints, feet = rng.permutation(len(case.log.joint_names)), np.arange(len(case.log.contact_names))[::-1]
    lifted = without(case.log, 1, slice(100, None))
    log = replace(
        lifted,
        joint_names=tuple(np.array(case.log.joint_names)[joints].tolist()),
        joint_position=case.log.joint_position[:, joints],
        contact_names=tuple(np.array(case.log.contact_names)[feet].tolist()),
        contact_active=value(lifted.contact_active)[:, feet],
    )
    np.testing.assert_array_equal(found(case, log).log.base_quat_xyzw, found(case, lifted).log.base_quat_xyzw)


def test_what_was_recorded_of_the_base_is_not_used() -> None:
    case = stance("quadruped")
    count = len(case.log)
    wrong = replace(
        case.log,
        base_quat_xyzw=np.tile([0.6, 0.0, 0.0, 0.8], (count, 1)),
        base_angular_velocity_base=np.ones((count, 3)),
        imu_frame=robot_of(case.machine).base_link,
        imu_specific_force=np.ones((count, 3)),
        imu_angular_velocity=np.ones((count, 3)),
    )
    standing = found(case, wrong)
    assert standing.log.imu_frame == ""
    for name in (x for chain in DERIVATIVE_CHAINS for x in chain if x.startswith(("base_", "imu_"))):
        assert name == "base_position_world" or getattr(standing.log, name) is None, name
    assert_same_pose(standing, case, EXACT)


# ---------------------------------------------------------------------------------------------------------- derivatives


def with_pose(
    log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float | None = None, rate_hz: float | None = None
) -> Samples:
    """Samples of a log with the motion of the base from the feet that stand."""
    settings = PreprocessingConfig(cutoff_hz=cutoff_hz, sample_rate_hz=rate_hz, base_motion="contacts")
    config = AnalyzeConfig(robot=RobotConfig(urdf=robot.path), preprocessing=settings, output=None)
    setup = RobotSetup(config=config, robot=robot, contacts=tuple(contacts))
    return LogReader(setup).samples_of(log, Path(log.source), None)


@pytest.mark.parametrize("name", ["quadruped", "humanoid"])
@pytest.mark.parametrize("normal", [LEVEL, ASKEW], ids=["level", "askew"])
@pytest.mark.parametrize("rates", [(None, None), (12.0, None), (12.0, 60.0)], ids=["as is", "filtered", "resampled"])
def test_its_derivatives_are_those_of_a_measured_pose(
    name: str, normal: tuple[float, float, float], rates: tuple[float | None, float | None]
) -> None:
    case = stance(name, normal, 0.0, ((1, 50, 90),))
    robot, contacts = robot_of(case.machine), case.contacts()
    measured = bind_log(preprocess(case.measured, *rates), robot, contacts)
    derived = with_pose(case.log, robot, contacts, *rates)
    np.testing.assert_array_equal(derived.time, measured.time)
    np.testing.assert_array_equal(derived.joint_acceleration, measured.joint_acceleration)
    for field in MOTION:
        x, true = (value(getattr(samples.base, field)).numpy() for samples in (derived, measured))
        np.testing.assert_allclose(x, true, rtol=0.0, atol=1e-9 * np.abs(true).max(), err_msg=field)


def test_a_floor_whose_slope_is_not_stated_tilts_gravity_by_that_slope() -> None:
    case = stance("quadruped", AHEAD)
    robot = robot_of(case.machine)
    level = tuple(replace(contact, normal=LEVEL) for contact in case.contacts())
    forces = [value(with_pose(case.log, robot, c).base.specific_force).numpy() for c in (case.contacts(), level)]
    angle = np.arccos((forces[0] * forces[1]).sum(axis=1) / np.prod(np.linalg.norm(forces, axis=2), axis=0))
    assert abs(np.median(angle) - 0.15) < 0.02


# ----------------------------------------------------------------------------------------------------------------- gaps


def with_gap(case: Stance) -> Log:
    """Two feet in the air for a while, though they stand: the base's motion is not known then."""
    return without(without(case.log, 0, slice(70, 90)), 3, slice(70, 90))


@pytest.mark.parametrize("rates", [(None, None), (12.0, None), (12.0, 60.0)], ids=["as is", "filtered", "resampled"])
def test_nothing_is_differentiated_across_samples_with_too_few_feet(rates: tuple[float | None, float | None]) -> None:
    case = stance("quadruped")
    robot, contacts, log = robot_of(case.machine), case.contacts(), with_gap(case)
    with pytest.warns(TorchidWarning, match=r"20 of 160 samples dropped.* \(too few standing feet: 20\)") as caught:
        whole = with_pose(log, robot, contacts, *rates)
    assert len(caught) == 1
    assert not ((whole.time > log.time[69]) & (whole.time < log.time[90])).any()
    parts = [with_pose(log.select(x), robot, contacts, *rates) for x in (slice(0, 70), slice(90, None))]
    assert len(whole) == sum(map(len, parts))
    for name in ("time", "joint_acceleration"):
        together = np.concatenate([value(getattr(part, name)) for part in parts])
        np.testing.assert_allclose(getattr(whole, name), together, rtol=0.0, atol=1e-9, err_msg=name)
    forces = [value(x.base.specific_force).numpy() for x in (whole, *parts)]
    np.testing.assert_allclose(forces[0], np.concatenate(forces[1:]), rtol=0.0, atol=1e-9)


def test_segments_too_short_for_the_filter_are_dropped_and_counted() -> None:
    case = stance("quadruped")
    robot, contacts = robot_of(case.machine), case.contacts()
    log = without(without(with_gap(case), 0, slice(100, 103)), 3, slice(100, 103))
    with pytest.warns(
        TorchidWarning, match=r"33 of 160 .*few standing feet: 23, segments too short to differentiate: 10"
    ):
        whole = with_pose(log, robot, contacts, 12.0)
    assert not ((whole.time > log.time[69]) & (whole.time < log.time[103])).any()
    with pytest.warns(TorchidWarning, match="23 of 160"):
        assert ((unfiltered := with_pose(log, robot, contacts)).time < log.time[100]).sum() > 66
    assert len(unfiltered) == 160 - 23 - 3 * 4
    message = refused(lambda: with_pose(log, robot, contacts, 4.0), "quadruped: time: segments of at")
    assert "more than 1 s" in message


@pytest.mark.parametrize("foot", [0, 3])
def test_a_heading_is_kept_by_two_feet_that_stand_through_a_gap(foot: int) -> None:
    case = stance("quadruped", ASKEW)
    log = without(without(case.log, foot, slice(70, 90)), 1, slice(70, 90))
    standing = found(case, log)
    assert standing.segments == (slice(0, 70), slice(90, 160))
    assert_same_pose(standing, case, EXACT, slice(0, 70))
    assert_same_pose(standing, case, 1e-8, slice(90, None))
    unknown = np.isnan(value(standing.log.base_quat_xyzw)).all(axis=1)
    assert np.flatnonzero(unknown).tolist() == list(range(70, 90))


def test_a_heading_that_is_lost_on_a_slope_ends_what_is_used() -> None:
    lifted = stance("humanoid", ASKEW).log
    lifted = without(without(lifted, 0, slice(70, 90)), 1, slice(70, 90))
    standing = found(stance("humanoid", ASKEW), lifted)
    assert standing.segments == (slice(0, 70),)
    assert standing.dropped == {"too few standing feet": 20, "heading unknown on a sloped floor": 70}
    level = found(stance("humanoid"), lifted, stance("humanoid").contacts())
    assert level.segments == (slice(0, 70), slice(90, 160))


# ------------------------------------------------------------------------------------------------------------- refusals


def test_a_log_that_says_nothing_of_the_base_is_refused_in_one_line() -> None:
    case = stance("quadruped")
    log, contacts, robot = case.log, case.contacts(), robot_of(case.machine)
    none = replace(log, contact_active=np.zeros_like(value(log.contact_active)))
    refused(lambda: found(case, none), "quadruped: contact_active: no contact stands in any sample", LogError)
    two = without(without(log, 0), 1)
    refused(lambda: found(case, two), "quadruped: contact_active: at most 2 contacts at the same time", LogError)
    refused(lambda: found(case, replace(log, contact_active=None)), "quadruped: contact_active: missing", LogError)
    unnamed = replace(log, contact_names=("a", *log.contact_names[1:]))
    refused(lambda: found(case, unnamed), "quadruped: contact_names: contact 'front_left_foot' missing", LogError)
    fewer = replace(log, joint_names=log.joint_names[1:], joint_position=log.joint_position[:, 1:])
    refused(
        lambda: found(case, fewer),
        "quadruped: joint_names: missing joints of quadruped.urdf: front_left_hip;",
        LogError,
    )
    other = replace(log, joint_names=("knie", *log.joint_names[1:]))
    refused(lambda: found(case, other), "quadruped: joint_names: unknown name 'knie'", UnknownNameError)
    wrench = replace(log, contact_wrench_world=np.zeros((len(log), 4, 6)))
    refused(
        lambda: found(case, wrench),
        "quadruped: contact_wrench_world: preprocessing.base_motion: contacts does not know",
        LogError,
    )
    normals = np.tile(np.array(AHEAD), (len(log), 4, 1))
    tilted = replace(log, contact_normal_world=normals)
    refused(lambda: found(case, tilted), "quadruped: contact_normal_world: differs from contacts[].normal", LogError)
    base_pose_from_feet(tilted, robot, tuple(replace(contact, normal=AHEAD) for contact in contacts))


def test_feet_in_a_line_say_nothing_of_the_tilt_about_it() -> None:
    case = stance("quadruped")
    leg = tuple(f"front_left_{part}" for part in ("thigh_link", "shank_link", "foot"))
    contacts = tuple(Contact(name, "point") for name in leg)
    active = np.ones((len(case.log), 3), dtype=bool)
    straight = np.zeros_like(case.log.joint_position)
    bent = straight + (np.arange(len(straight)) >= 100)[:, None]
    log = replace(case.log, joint_position=straight, contact_names=leg, contact_active=active)
    line = "quadruped: contact_active: all standing feet are on one line"
    refused(lambda: found(case, log, contacts), line, LogError)
    standing = found(case, replace(log, joint_position=bent), contacts)
    assert standing.dropped == {"standing feet on one line": 100}
    assert standing.segments == (slice(100, 160),)


def test_a_sole_that_has_no_axis_towards_the_base_is_refused() -> None:
    case = stance("humanoid")
    robot = robot_of(case.machine)
    names = list(robot.joint_names)
    lying = case.log.joint_position.copy()
    lying[:, names.index("left_ankle_pitch_joint")] += np.pi / 4.0
    message = refused(
        lambda: found(case, replace(case.log, joint_position=lying)), "humanoid: contact_names: no axis of flat foot"
    )
    assert "no axis of flat foot left_ankle_roll_link points to the base" in message


def test_feet_that_are_not_on_one_floor_are_warned_of() -> None:
    case = stance("quadruped")
    robot, contacts = robot_of(case.machine), case.contacts()
    bent = case.log.joint_position.copy()
    bent[:, list(robot.joint_names).index("front_left_knee")] += 0.4
    with pytest.warns(TorchidWarning, match=r"standing feet are \d+ mm \(rms\) off a common plane. Check joint zeros"):
        with_pose(replace(case.log, joint_position=bent), robot, contacts)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with_pose(case.log, robot, contacts)
