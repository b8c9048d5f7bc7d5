"""What noise of the motion adds to the normal equations, by samples with noise drawn again and again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from arms import ARMS
from torch import Tensor

import torchid
from torchid.problem import RowBuilder, Samples, TriangularFactor, assemble, compress, compress_parts
from torchid.problem.compression import compress_in_blocks, merge_factors, split_into_folds
from torchid.problem.elimination import column_prior
from torchid.problem.motion import BaseMotion, MotionNoise
from torchid.problem.noise_gram import LEAST_SIGNAL, ColumnPrior, NoiseShares, corrected_triangle
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, named_sensors

NOISE = 0.05


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    path: Path = tmp_path_factory.mktemp("robot") / "arms.urdf"
    path.write_text(ARMS)
    return torchid.load_robot(path)


@pytest.fixture(scope="module")
def builder(robot: Robot) -> RowBuilder:
    contacts = [Contact("b", "point"), Contact("a", "line")]
    return RowBuilder(robot, contacts, named_sensors("joints", robot.n, 2, SensorNoise(0.1, 1.0, 0.1)))


def unit_noise(size: float) -> MotionNoise:
    generator = torch.Generator().manual_seed(3)
    joints, base = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((2, 3, 3), (12, 12)))
    return MotionNoise(size * joints, 0.3 * size * base, turns_force=True)


def motion(robot: Robot, count: int, size: float = NOISE) -> Samples:
    """Random motion in four contact states."""
    generator = torch.Generator().manual_seed(1)

    def draw(width: int) -> Tensor:
        return torch.randn(count, width, generator=generator, dtype=torch.float64)

    quat = torch.nn.functional.normalize(draw(4), dim=1)
    active = torch.arange(count)[:, None] // torch.tensor([30, 50]) % 2 == 0
    return Samples(
        "random.npz",
        torch.arange(count, dtype=torch.float64) / 100.0,
        0.6 + 0.2 * draw(2),
        draw(2),
        draw(2),
        BaseMotion(quat, 9.0 + draw(3), draw(3), draw(3)),
        draw(2),
        None,
        False,
        active,
        motion_noise=unit_noise(size),
    )


def gram(factor: TriangularFactor) -> np.ndarray:
    R = factor.triangle().numpy()
    return np.asarray(R.T @ R)


def draws(samples: Samples, count: int) -> Iterator[Samples]:
    """The samples with Gaussian noise."""
    noise, generator = samples.motion_noise, torch.Generator().manual_seed(2)
    assert noise is not None
    for _ in range(count):
        z = torch.randn(len(samples), 18, generator=generator, dtype=torch.float64)
        q, v, a = torch.einsum("jkl,bjl->kbj", noise.joints, z[:, :6].unflatten(1, (2, 3)))
        base = z[:, 6:] @ noise.base.T
        perturbed = samples.perturbed(noise, torch.zeros(len(samples), 1, dtype=torch.float64))
        moved = perturbed.base
        if moved.specific_force is not None:
            turn = torch.linalg.cross(base[:, :3], samples.base.specific_force)
            moved = replace(
                moved,
                specific_force=samples.base.specific_force - turn + base[:, 9:],
                angular_velocity=samples.base.angular_velocity + base[:, 3:6],
                angular_acceleration=samples.base.angular_acceleration + base[:, 6:9],
            )
        yield replace(
            samples,
            joint_position=samples.joint_position + q,
            joint_velocity=samples.joint_velocity + v,
            joint_acceleration=samples.joint_acceleration + a,
            base=moved,
            motion_noise=None,
        )


def test_the_noise_gram_is_what_noise_adds_on_average(robot: Robot, builder: RowBuilder) -> None:
    samples = motion(robot, 2000, 0.04)
    found = compress([samples], builder)
    plain = gram(compress([replace(samples, motion_noise=None)], builder))
    assert np.array_equal(gram(found), plain), "the factor itself stays"
    noisy = [gram(compress([one], builder)) for one in draws(samples, 40)]
    size = np.sqrt(np.diag(plain)).clip(1e-9)
    expected, scatter, noise_gram = (
        x / np.outer(size, size)
        for x in (np.mean(noisy, axis=0) - plain, np.std(noisy, axis=0), found.whole_noise_gram().numpy())
    )
    chance = np.linalg.norm(scatter) / np.sqrt(40)
    assert np.linalg.norm(noise_gram - expected) < 2.0 * chance + 0.1 * np.linalg.norm(expected)
    assert np.linalg.norm(expected) > 3.0 * chance, "or nothing is shown"


def test_parts_and_blocks_have_their_own_and_together_that_of_all(robot: Robot, builder: RowBuilder) -> None:
    samples = motion(robot, 2000)
    whole = compress([samples], builder).whole_noise_gram()
    parts = compress_in_blocks(split_into_folds([samples], builder), builder)
    assert len({(part.fold, part.block) for part in parts}) > 10
    assert all(part.factor.noise_gram for part in parts)
    together = merge_factors((part.factor for part in parts), builder).whole_noise_gram()
    assert torch.allclose(together, whole, rtol=0.0, atol=1e-12 * float(whole.norm()))
    one = next(part for part in parts if part.fold == 2 and part.block == 1)
    own = [x for x in split_into_folds([samples], builder) if x.fold == 2]
    cut = [x[int(len(x) * k / 4) : int(len(x) * (k + 1) / 4)] for x in own for k in (1,)]
    alone = {part.state: part.factor.whole_noise_gram() for part in compress_parts(cut, builder)}
    assert torch.allclose(one.factor.whole_noise_gram(), alone[one.state], rtol=0.0, atol=1e-9)


def test_long_logs_are_sampled(robot: Robot, builder: RowBuilder, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = motion(robot, 6000)
    whole = compress([samples], builder).whole_noise_gram().numpy()
    monkeypatch.setattr("torchid.problem.noise_gram._MOST_PERTURBED", 1500)
    sampled = compress([samples], builder).whole_noise_gram().numpy()
    size = np.sqrt(np.diag(gram(compress([samples], builder))).clip(1e-9))
    off, scaled = ((x / np.outer(size, size)) for x in (sampled - whole, whole))
    assert 0.0 < np.linalg.norm(off) < 0.3 * np.linalg.norm(scaled)


def test_a_corrected_factor_is_that_of_the_rows_without_noise(robot: Robot, builder: RowBuilder) -> None:
    factor = compress([motion(robot, 2000, 0.01)], builder)
    corrected_factor = corrected_triangle(factor, column_prior(builder, robot))
    R, noise = corrected_factor.R, corrected_factor.noise
    assert corrected_factor.shrinkage is None
    plain, noise_gram = gram(factor), factor.whole_noise_gram().numpy()
    assert 0.0 < noise.largest < 1.0 - LEAST_SIGNAL
    assert noise.lost == 0
    corrected = R.T @ R
    size = np.sqrt(np.diag(plain))[:-1].clip(1e-9)
    off = (corrected - (plain - noise_gram)) / np.outer(np.append(size, size.max()), np.append(size, size.max()))
    assert np.abs(off[:-1]).max() < 1e-9, "all but the square of the right-hand side"
    best = np.linalg.lstsq(R[:-1, :-1], R[:-1, -1], rcond=1e-9)[0]
    rows = factor.triangle().numpy()
    residual = np.square(rows[:, -1] - rows[:, :-1] @ best).sum()
    assert np.square(R[:, -1] - R[:, :-1] @ best).sum() == pytest.approx(residual, rel=1e-9), "of the rows as they are"


SHARES = (-0.1, 0.2, 0.5, 0.7, 0.8, 0.9, 0.99)
"""Of noise in the information on combinations of parameters; the last four are beyond what is taken off."""


def factor_with(shares: tuple[float, ...], phi: np.ndarray) -> tuple[TriangularFactor, np.ndarray]:
    """A factor with as much noise in combinations (k, k), whose normal equations without it have the solution phi."""
    rng, count = np.random.default_rng(2), len(shares)
    X, y = rng.normal(size=(200, count)) * 10.0 ** rng.uniform(-2.0, 2.0, count), rng.normal(size=200)
    U, values, Vh = np.linalg.svd(X, full_matrices=False)
    turn = np.linalg.qr(rng.normal(size=(count, count)))[0]
    combinations = turn.T @ (values[:, None] * Vh)
    noise_gram = np.zeros((count + 1, count + 1))
    noise_gram[:-1, :-1] = combinations.T * shares @ combinations
    noise_gram[:-1, -1] = noise_gram[-1, :-1] = X.T @ y - (X.T @ X - noise_gram[:-1, :-1]) @ phi
    factor, support = TriangularFactor(count), tuple(range(count))
    factor.add(support, torch.from_numpy(np.column_stack([X, y])))
    factor.add_noise_gram({support: torch.from_numpy(noise_gram)})
    return factor, combinations


@pytest.mark.parametrize("lost", [0, 4])
def test_combinations_that_are_mostly_noise_follow_the_data_as_far_as_these_go_and_the_prior_beyond(lost: int) -> None:
    rng, shares = np.random.default_rng(5), SHARES[: len(SHARES) - 4 + lost]
    count = len(shares)
    prior = ColumnPrior(rng.normal(size=count - 1), rng.normal(size=(count - 1, count + 2)))  # and an extra column
    deviations = rng.normal(size=count + 2)
    phi, nominal = np.append(prior.nominal + prior.spread @ deviations, 0.0), np.append(prior.nominal, 0.0)
    factor, combinations = factor_with(shares, phi)
    corrected = corrected_triangle(factor, prior)
    best = np.linalg.solve(corrected.R[:-1, :-1], corrected.R[:-1, -1])
    follows = np.minimum((1.0 - np.array(shares)) / LEAST_SIGNAL, 1.0)
    expected = follows * (combinations @ (phi - nominal))
    assert np.allclose(combinations @ (best - nominal), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert corrected.noise.lost == lost
    if not lost:
        assert corrected.shrinkage is None
        return
    assert corrected.shrinkage is not None
    off = combinations @ (phi - corrected.shrinkage[:, : count + 2] @ deviations - best)
    assert np.abs(off).max() < 1e-9 * np.abs(expected).max()
    of_extra = np.abs(corrected.shrinkage[:, count + 2 :])
    along = (1.0 - follows) * combinations[:, -1] * best[-1]
    assert np.allclose(combinations @ corrected.shrinkage[:, -1], along, rtol=1e-9, atol=1e-9 * of_extra.max())


@pytest.mark.parametrize("size", [0.0, 0.5, 1.0])
def test_no_more_noise_is_taken_off_than_the_rows_leave_unexplained(robot: Robot, size: float) -> None:
    """Of motion with as many times the noise that is taken for there; forces are exact."""
    bolted = torchid.load_robot(robot.path, fixed_base=True)
    builder = RowBuilder(bolted, [], named_sensors("joints", bolted.n, 0, SensorNoise(0.1, 1.0, 0.1)))
    stated, there = (replace(unit_noise(x), base=torch.zeros(12, 12, dtype=torch.float64)) for x in (0.1, 0.1 * size))
    bare = {"base": BaseMotion(), "active": torch.zeros(4000, 0, dtype=torch.bool)}
    clean = replace(motion(bolted, 4000, 0.1), **bare, motion_noise=replace(there, turns_force=False))
    forces = torchid.Regressor(bolted)(*clean.coordinates()) @ torch.from_numpy(bolted.nominal.flatten())
    noisy = next(draws(replace(clean, torque=forces), 1))
    factor = compress([replace(noisy, motion_noise=replace(stated, turns_force=False))], builder)
    R, triangle = corrected_triangle(factor, column_prior(builder, bolted)).R, factor.triangle().numpy()
    off, of_noise = (triangle.T @ triangle - R.T @ R)[:-1, :-1], factor.whole_noise_gram().numpy()[:-1, :-1]
    assert off.sum() == pytest.approx(size**2 * of_noise.sum(), rel=0.1, abs=1e-9 * of_noise.sum())


def test_without_noise_nothing_changes(robot: Robot, builder: RowBuilder) -> None:
    factor = compress([replace(motion(robot, 300), motion_noise=None)], builder)
    assert not factor.noise_gram
    prior = column_prior(builder, robot)
    corrected = corrected_triangle(factor, prior)
    R, noise = corrected.R, corrected.noise
    assert corrected.shrinkage is None
    assert np.allclose(R, factor.triangle().numpy(), rtol=1e-12)
    assert noise == NoiseShares()
    little = compress([motion(robot, 300, 1e-9)], builder)
    assert np.allclose(corrected_triangle(little, prior).R, little.triangle().numpy(), rtol=1e-12), (
        "far below all errors"
    )


def test_parameters_of_noisy_motion_are_no_more_too_small(robot: Robot) -> None:
    bolted = torchid.load_robot(robot.path, fixed_base=True)
    builder = RowBuilder(bolted, [], named_sensors("joints", bolted.n, 0, SensorNoise(0.1, 1.0, 0.1)))
    moving = motion(bolted, 4000, 0.1)
    noise = replace(unit_noise(0.1), base=torch.zeros(12, 12, dtype=torch.float64), turns_force=False)
    clean = replace(moving, base=BaseMotion(), active=torch.zeros(4000, 0, dtype=torch.bool), motion_noise=noise)
    forces = torchid.Regressor(bolted)(*clean.coordinates()) @ torch.from_numpy(bolted.nominal.flatten())
    noisy, errors = next(draws(replace(clean, torque=forces), 1)), []
    for known in (None, noise):
        problem = assemble(compress_parts([replace(noisy, motion_noise=known)], builder), builder, bolted).problem
        found = np.linalg.lstsq(problem.A, problem.b, rcond=1e-9)[0]
        truth = problem.A @ bolted.nominal.flatten()
        errors.append(np.linalg.norm(problem.A @ found - truth) / np.linalg.norm(truth))
    assert errors[0] > 0.02
    assert errors[1] < 0.3 * errors[0]


def test_no_more_is_taken_off_than_leaves_a_third(robot: Robot, builder: RowBuilder) -> None:
    factor = compress([motion(robot, 500, 1.0)], builder)
    corrected = corrected_triangle(factor, column_prior(builder, robot))
    R, noise = corrected.R, corrected.noise
    assert 0 < noise.lost <= noise.combinations
    assert noise.largest > 1.0 - LEAST_SIGNAL
    assert "are mostly noise and stay near the nominal values" in str(noise)
    plain = factor.triangle().numpy()[:, :-1]
    U, values, Vh = np.linalg.svd(plain, full_matrices=False)
    kept = values > 1e-9 * values[0]
    left = np.linalg.svd(R[:, :-1] @ (Vh[kept].T / values[kept]), compute_uv=False)
    assert left.min() == pytest.approx(np.sqrt(LEAST_SIGNAL), rel=1e-6)
