"""Conditions in an experiment file: what is written is what holds, and a slip is answered in one line."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from experiments import LEAST
from refusals import refused
from repository import CONFIGS, DEMO
from synthetic import G1, SOLO12, Oracle, load, make_log
from urdfs import INERTIAL, ball, joint, link, table, write

from torchid.config import dump_config, load_config
from torchid.config.estimator import EstimatorConfig
from torchid.errors import ConfigError, InputError, TorchidWarning, UnknownNameError, about_file
from torchid.estimators import Conditions, violations
from torchid.estimators.conditions import mirror_matrix
from torchid.fitting.experiment import batch_estimator
from torchid.fitting.prior_knowledge import conditions_from
from torchid.parameters import PARAMETERS
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.problem.linear import parameter_scale
from torchid.robot import Robot, body_extents
from torchid.sensing import Contact, named_sensors

BIPED = CONFIGS / "biped.urdf"


def settings_of(folder: Path, **keys: Any) -> EstimatorConfig:
    """Of an experiment file that says so."""
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump(LEAST | {"estimator": {"name": "consistent", **keys}}))
    config = load_config(path)
    path.write_text(dump_config(config))
    assert load_config(path) == config, "what a run writes down reads back as itself"
    return config.estimator


def conditions(folder: Path, robot: Robot, **keys: Any) -> Conditions:
    settings = settings_of(folder, **keys)
    with about_file("experiment.yaml"):
        return conditions_from(settings, robot)


def refusal(folder: Path, robot: Robot, kind: type[InputError] = ConfigError, **keys: Any) -> str:
    """The one line with which conditions are refused, less the file."""
    start = "experiment.yaml: estimator."
    return refused(lambda: conditions(folder, robot, **keys), start, kind).removeprefix(start)


@pytest.fixture(scope="module")
def biped() -> Robot:
    return load(BIPED)


# ----------------------------------------------------------------------------------------------------------- values


def test_bounds_stand_at_their_bodies_and_parameters(tmp_path: Path, biped: Robot) -> None:
    bounds = {"l_shank": {"m": [0.5, 1], "fc": [0, 2]}, "pelvis": {"mcx": [None, 0.25], "Iyz": [-0.5, None]}}
    found = conditions(tmp_path, biped, bounds=bounds | {"torso": {"m": [12, 12]}})
    lower, upper = found.bounds(len(biped.bodies))
    expected = {("l_shank", "m"): (0.5, 1.0), ("l_shank", "fc"): (0.0, 2.0), ("pelvis", "mcx"): (-np.inf, 0.25),
                ("pelvis", "Iyz"): (-0.5, np.inf), ("torso", "m"): (12.0, 12.0)}  # fmt: skip
    for body, name in enumerate(biped.body_names):
        for number, parameter in enumerate(PARAMETERS):
            low, high = expected.get((name, parameter), (0.0 if parameter in ("fc", "fv") else -np.inf, np.inf))
            assert (lower[body, number], upper[body, number]) == (low, high)


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
@pytest.mark.parametrize("shapes", ["visual", "collision"])
def test_centres_of_mass_are_kept_in_what_encloses_the_shapes(kind: str, shapes: Any, tmp_path: Path) -> None:
    robot = load(SOLO12)
    found = conditions(tmp_path, robot, com_inside=kind, com_shapes=shapes)
    extents = body_extents(robot, shapes)
    assert [enclosure.body for enclosure in found.enclosures] == list(extents)
    for enclosure, extent in zip(found.enclosures, extents.values(), strict=True):
        assert enclosure.kind == kind
        np.testing.assert_array_equal(enclosure.half, extent.half if kind == "box" else extent.semi_axes)
        np.testing.assert_array_equal(enclosure.centre, extent.centre)
        np.testing.assert_array_equal(enclosure.axes, extent.axes)


def test_frozen_bodies_and_bodies_without_mass_are_not_enclosed_nor_complained_of(tmp_path: Path) -> None:
    elements = [link("base", INERTIAL + ball(0.1)), link("arm"), link("hand", INERTIAL + ball(0.2)), link("ghost", "")]
    joints = [joint("a", "base", "arm"), joint("b", "arm", "hand"), joint("c", "hand", "ghost")]
    robot = load(write(tmp_path, *elements, *joints))
    with pytest.warns(TorchidWarning, match="no shapes at arm: their extent") as caught:
        assert [e.body for e in conditions(tmp_path, robot, com_inside="box").enclosures] == [0, 2]
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frozen = conditions(tmp_path, robot, com_inside="box", frozen=["arm", "base"])
    assert [e.body for e in frozen.enclosures] == [2]


def test_a_urdf_that_contradicts_its_own_shapes_is_warned_of(tmp_path: Path) -> None:
    """The collision shapes at the feet of G1 are four balls under the sole."""
    robot = load(G1)
    with pytest.warns(TorchidWarning) as caught:
        conditions(tmp_path, robot, com_inside="ellipsoid", com_shapes="collision")
    (message,) = (str(warning.message) for warning in caught)
    assert message.startswith("experiment.yaml: estimator.com_inside: the centre of mass of the URDF is outside the")
    assert "ellipsoid of left_ankle_roll_link, right_ankle_roll_link. Check" in message
    assert conditions(tmp_path, robot, com_inside="ellipsoid").enclosures


def test_left_and_right_become_mirror_images(tmp_path: Path, biped: Robot) -> None:
    found = conditions(tmp_path, biped, symmetry={"left": "l_", "right": "r_"}).mirrors
    assert len(found) == 7
    for mirror in found:
        assert biped.body_names[mirror.body].replace("l_", "r_") == biped.body_names[mirror.image]
        image = mirror_matrix(mirror.reflection) @ biped.nominal[mirror.body]
        np.testing.assert_allclose(image, biped.nominal[mirror.image], rtol=0.0, atol=1e-12)


# --------------------------------------------------------------------------------------------------------- refusals


@table({
    "lower above upper": ({"torso": {"m": [2, 1]}}, "bounds.torso.m: lower 2 is above upper 1; accepted: [lower, up"),
    "frozen": ({"waist": {"m": [1, 2]}}, "bounds.waist.m: a bound, but the body is frozen"),
    "base's friction": ({"pelvis": {"fv": [0, 1]}}, "bounds.pelvis.fv: a bound on friction, but pelvis is the base"),
    "negative friction": ({"torso": {"fc": [-1, 1]}}, "bounds.torso.fc: [-1.0, 1.0]; accepted: bounds of at least 0"),
    "friction at most negative": ({"torso": {"fv": [None, -1]}}, "bounds.torso.fv: [None, -1.0]; accepted: bounds"),
    "no mass": ({"torso": {"m": [None, 0]}}, "bounds.torso.m: upper bound 0; accepted: an upper bound above 0"),
    "no inertia": ({"torso": {"Iyy": [None, -2]}}, "bounds.torso.Iyy: upper bound -2; accepted: an upper bound"),
})  # fmt: skip
def test_bounds_that_nothing_meets_are_refused(case: tuple, tmp_path: Path, biped: Robot) -> None:
    bounds, found = case
    assert refusal(tmp_path, biped, bounds=bounds, frozen=["waist"]).startswith(found)


def test_bounds_on_what_is_not_fitted_are_refused(tmp_path: Path, biped: Robot) -> None:
    message = refusal(tmp_path, biped, bounds={"torso": {"fc": [0, 1]}}, friction=False)
    assert (
        message
        == "bounds.torso.fc: a bound on friction, but friction is not fitted; accepted: estimator.friction: true"
    )
    robot = load(write(tmp_path, link("base"), link("ghost", ""), joint("a", "base", "ghost")))
    message = refusal(tmp_path, robot, bounds={"ghost": {"m": [0.1, 1]}})
    assert message.startswith("bounds.ghost.m: a bound, but ghost has no mass in the URDF")
    assert conditions(tmp_path, robot, bounds={"ghost": {"fc": [0.1, 1]}}).upper is not None


def test_unknown_names_are_answered_with_the_nearest(tmp_path: Path, biped: Robot) -> None:
    message = refusal(tmp_path, biped, UnknownNameError, bounds={"l_shnk": {"m": [0, 1]}})
    assert message.startswith("bounds: unknown name 'l_shnk'; accepted: l_shank")
    message = refusal(tmp_path, biped, UnknownNameError, bounds={"l_shank": {"mass": [0, 1]}})
    assert message.startswith("bounds.l_shank: unknown name 'mass'; accepted: m, mcx, ")
    message = refusal(tmp_path, biped, UnknownNameError, bounds={"l_shank": {"Ixxx": [0, 1]}})
    assert message.startswith("bounds.l_shank: unknown name 'Ixxx'; accepted: Ixx")


def test_symmetry_that_is_none_is_refused_by_its_key(tmp_path: Path, biped: Robot) -> None:
    message = refusal(tmp_path, biped, symmetry={"left": "links", "right": "rechts"})
    assert message.startswith(
        "symmetry: no two bodies differ in 'links' and 'rechts'; accepted: parts of names: pelvis"
    )
    message = refusal(tmp_path, biped, symmetry={"left": "l_", "right": "r_", "normal": "x"})
    assert "l_hip and r_hip miss being mirror images along x by 0.2 m, in a robot of " in message


def test_centres_of_mass_inside_nothing_are_refused(tmp_path: Path) -> None:
    robot = load(DEMO / "quadruped.urdf")
    with pytest.warns(TorchidWarning, match="no shapes at trunk, front_left_hip_link"):
        message = refusal(tmp_path, robot, com_inside="box")
    assert message.startswith("com_inside: box, but no fitted body in quadruped.urdf has a shape")
    message = refusal(tmp_path, robot, com_shapes="collision")
    assert message.startswith(
        "com_shapes: collision, but com_inside is not set; accepted: com_inside: box or ellipsoid"
    )


# --------------------------------------------------------------------------------------------------------- whole runs


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_all_conditions_hold_together_where_least_squares_breaks_each(kind: str, tmp_path: Path) -> None:
    """On torques that are mostly noise."""
    robot, feet = load(SOLO12), ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
    contacts = [Contact(foot, "point") for foot in feet]
    builder = RowBuilder(robot, contacts, named_sensors("joints", robot.n, 4))
    rng = np.random.default_rng(0)
    log = make_log(Oracle.of(robot), [(foot, 3) for foot in feet], [[True] * 4], 40, rng)
    assert log.joint_torque is not None
    log = replace(log, joint_torque=log.joint_torque + 5.0 * rng.normal(size=log.joint_torque.shape))
    problem = linear_problem(compress([bind_log(log, robot, contacts)], builder), builder, robot)
    keys = {"com_inside": kind, "symmetry": {"left": "L_", "right": "R_"}, "total_mass": 2.5,
            "bounds": {"base_link": {"m": [1.2, 1.3]}, "FL_SHOULDER": {"fc": [0.05, 0.1]}}}  # fmt: skip
    settings = settings_of(tmp_path, ridge=1e-3, margin=1e-3, **keys)
    wanted, scale = conditions_from(settings, robot), parameter_scale(robot.nominal)
    phi = batch_estimator(settings, wanted).solve(problem).phi.reshape(robot.nominal.shape)
    assert violations(phi, scale, wanted, 1e-7) == []
    assert phi[:, 0].sum() == pytest.approx(2.5)
    plain = batch_estimator(replace(settings, name="least_squares"), wanted).solve(problem).phi
    broken = " ".join(found.condition for found in violations(plain.reshape(phi.shape), scale, wanted))
    for word in (
        f"outside its {kind}",
        "not the mirror image",
        "total mass",
        "m beyond its bounds",
        "fc beyond",
        "margin",
    ):
        assert word in broken
