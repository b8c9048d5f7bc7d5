"""Left and right of a robot: paired by name, checked by geometry, and mirrored matter is where it should be."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from physical import of_points
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import Array, load
from urdfs import joint, link, table, words, write

from torchid.errors import ConfigError, about_file
from torchid.estimators.conditions import mirror_matrix
from torchid.robot import Robot, mirror_pairs


def names(robot: Robot, *tokens: str, **options: object) -> set[tuple[str, str]]:
    """The pairs, by name."""
    pairs = mirror_pairs(robot, *tokens, **options)  # type: ignore[arg-type]
    return {(robot.body_names[pair.body], robot.body_names[pair.image]) for pair in pairs}


# ------------------------------------------------------------------------------------------------- mirrored matter


def mirrored_robot(folder: Path, rng: np.random.Generator, normal: int = 1, **shift: Array) -> Robot:
    """A trunk with two arms of two links, the right one's frames turned any way, everything else mirrored."""
    D = np.eye(3)
    D[normal, normal] = -1.0
    elements, T = [link("trunk")], {}
    for side in ("left", "right"):
        parent, R_parent, p_parent = "trunk", np.eye(3), np.zeros(3)
        for part in ("upper", "lower"):
            name = f"{side}_{part}"
            if side == "left":
                R, p = Rotation.random(random_state=rng).as_matrix(), p_parent + rng.normal(size=3)
                axis = R @ rng.normal(size=3)
            else:
                R, (_, p, axis) = Rotation.random(random_state=rng).as_matrix(), T[f"left_{part}"]
                p, axis = D @ p + shift.get(part, np.zeros(3)), D @ axis * rng.choice([-1.0, 1.0])
                axis = axis + shift.get(f"{part}_axis", np.zeros(3))
            T[name] = (R, p, axis)
            xyz, rpy = R_parent.T @ (p - p_parent), Rotation.from_matrix(R_parent.T @ R).as_euler("xyz")
            origin = f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/><axis xyz="{words(R.T @ axis)}"/>'
            elements += [link(name), joint(f"{name}_joint", parent, name, extra=origin)]
            parent, R_parent, p_parent = name, R, p
    robot = load(write(folder, *elements))
    assert robot.body_names == ("trunk", "left_upper", "left_lower", "right_upper", "right_lower")
    return robot


@pytest.mark.parametrize("normal", ["x", "y", "z"])
def test_points_of_the_right_arm_are_those_of_the_left_seen_in_a_mirror(normal: str, tmp_path: Path) -> None:
    """However the right arm's frames are turned: made of mass points in the base frame, independent of the package."""
    rng, axis = np.random.default_rng(1), "xyz".index(normal)
    robot = mirrored_robot(tmp_path, rng, axis)
    pairs = mirror_pairs(robot, "left", "right", normal)
    assert [(pair.body, pair.image) for pair in pairs] == [(1, 3), (2, 4)]
    poses = robot.link_poses(torch.zeros(1, robot.n, dtype=torch.float64))
    for pair in pairs:
        mass, in_left = rng.uniform(0.1, 1.0, 6), rng.normal(size=(6, 3))
        T_left, T_right = (poses[robot.body_names[i]][0].numpy() for i in (pair.body, pair.image))
        in_base = in_left @ T_left[:3, :3].T + T_left[:3, 3]
        in_base[:, axis] *= -1.0
        in_right = (in_base - T_right[:3, 3]) @ T_right[:3, :3]
        left, right = of_points(mass, in_left), of_points(mass, in_right)
        left[10:] = right[10:] = [0.3, 0.7]
        np.testing.assert_allclose(mirror_matrix(pair.reflection) @ left, right, rtol=0.0, atol=1e-9)


# --------------------------------------------------------------------------------------------------------- refusals


def refusal(robot: Robot, *tokens: str, **options: object) -> str:
    """The one line, of a file called experiment.yaml."""
    with about_file("experiment.yaml"):
        return refused(partial(mirror_pairs, robot, *tokens, **options), "experiment.yaml: symmetry: ", ConfigError)


def test_a_pair_that_is_not_mirrored_is_refused_with_the_distance(tmp_path: Path) -> None:
    robot = mirrored_robot(tmp_path, np.random.default_rng(2), lower=np.array([0.0, 0.03, 0.04]))
    message = refusal(robot, "left", "right")
    assert "left_lower and right_lower miss being mirror images along y by 0.05 m, in a robot of " in message
    assert "left_upper and right_upper miss being " in refusal(robot, "left", "right", normal="z")
    near = mirrored_robot(tmp_path, np.random.default_rng(2), lower=np.array([0.0, 0.0, 1e-4]))
    assert len(mirror_pairs(near, "left", "right")) == 2


def arms(folder: Path, *bodies: str) -> Robot:
    """A trunk with a body on each side, two metres apart, and more on its middle."""
    elements = [link("shell_link")]
    for name in bodies:
        y = 1.0 if name.startswith("l_") else -1.0 if name.startswith("r_") else 0.0
        elements.append(link(name))
        origin = f'<origin xyz="0.5 {y} 0"/><axis xyz="0 0 1"/>'
        elements.append(joint(f"{name}_joint", "shell_link", name, extra=origin))
    return load(write(folder, *elements))


@table({
    "nothing": (["l_arm", "r_arm"], ("links", "rechts"),
                "no two bodies differ in 'links' and 'rechts'; accepted: parts of names: shell_link, l_arm, r_arm"),
    "equal": (["l_arm", "r_arm"], ("l_", "l_"), "'l_' for both sides"),
    "alone": (["l_arm", "r_arm", "l_leg"], ("l_", "r_"), "l_leg has no counterpart; accepted: a body named r_leg"),
    "alone, right": (["l_arm", "r_arm", "r_leg"], ("l_", "r_"), "r_leg has no counterpart"),
    "two": (["l_l", "r_l", "l_r"], ("l", "r"), "l_l corresponds to r_l and to l_r"),
})  # fmt: skip
def test_names_that_do_not_answer_to_each_other_are_refused(case: tuple, tmp_path: Path) -> None:
    bodies, tokens, found = case
    assert found in refusal(arms(tmp_path, *bodies), *tokens)


def test_joints_that_are_not_mirrored_are_refused_with_the_angle(tmp_path: Path) -> None:
    robot = mirrored_robot(tmp_path, np.random.default_rng(3), upper_axis=np.array([0.5, 0.0, 0.0]))
    assert "the joints of left_upper and right_upper are " in refusal(robot, "left", "right")


def test_a_pair_of_which_one_has_no_mass_is_refused(tmp_path: Path) -> None:
    origin = '<origin xyz="0 {} 0"/><axis xyz="0 0 1"/>'
    elements = [link("trunk"), link("l_arm"), link("r_arm", "")]
    joints = [joint(f"{s}_joint", "trunk", f"{s}_arm", extra=origin.format(y)) for s, y in (("l", 1), ("r", -1))]
    assert "one of l_arm and r_arm has no mass" in refusal(load(write(tmp_path, *elements, *joints)), "l_", "r_")
