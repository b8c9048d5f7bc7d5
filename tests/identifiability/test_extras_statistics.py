"""What is said of unknowns beside the bodies' parameters: standard errors, and which are confounded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from motions import value
from recordings import Miscalibration
from synthetic import Array, Oracle, load, make_log
from unknowns import fit
from urdfs import BASE, inertial, joint, link, write
from welded import SENSORS, machine

from torchid.identifiability.confounding import INFLATION_LIMIT
from torchid.logs import Log
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.chunks import chunks_by_state
from torchid.problem.elimination import free_parameters
from torchid.problem.extras import CHANNELS
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, named_sensors, with_ft_sensors

CONTACTS = (Contact("sole", "flat"), Contact("fin", "point"))
STATES = [[True, False], [True, True], [False, True], [False, False]]
NOISE = SensorNoise(joint_torque=0.5, contact_force=2.0, contact_moment=0.2, base_force=1e-6, base_moment=1e-7)
OFFSETS = ExtraTerms(offsets=dict.fromkeys(CHANNELS, "log") | {"ft_force": "all", "ft_moment": "all"})
Recorded = tuple[Robot, Oracle, list[Samples]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Two noise-free logs of the skew machine with sensors that are off, the same in both."""
    rng = np.random.default_rng(3)
    robot = load(machine(tmp_path_factory.mktemp("skew")), None, False, SENSORS[2:3])
    oracle = Oracle.of(robot)
    logs = [make_log(oracle, [("sole", 6), ("fin", 3)], STATES, 80, rng, name) for name in ("a.npz", "b.npz")]
    found = Miscalibration.random(logs[0], rng)
    return robot, oracle, [bind_log(found.read(log), robot, CONTACTS) for log in logs]


def sensors_of(robot: Robot) -> SensorSet:
    return with_ft_sensors(named_sensors("full", robot.n, len(CONTACTS), NOISE, ft=1), robot, robot.ft_names)


def noisy(samples: Samples, robot: Robot, generator: torch.Generator) -> Samples:
    """With the noise that is stated."""
    torque, wrench = value(samples.torque), value(samples.wrench)
    std = torch.from_numpy(NOISE.dof_std(robot.n, robot.n_dofs)), torch.from_numpy(NOISE.wrench_std)

    def noise(x: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        return x + scale * torch.randn(x.shape, generator=generator, dtype=torch.float64)

    return replace(samples, torque=noise(torque, std[0]), wrench=noise(wrench, std[1]))


def stacked(builder: RowBuilder, robot: Robot, logs: list[Samples]) -> tuple[Array, Array, list[tuple[str, str]]]:
    """All rows [K | extras], the extras of each log in columns of their own, the right-hand side, and the labels."""
    labels = [(log.source, x.label) for log in logs for x in builder.extras if x.per_log]
    labels += [("", x.label) for x in builder.extras if not x.per_log]
    count, M = builder.columns.count, builder.columns.parameter_map
    blocks, right = [], []
    for log in logs:
        for state, index in chunks_by_state(log):
            for support, rows in builder.rows(log[index], state):
                wide = np.zeros((len(rows), builder.width))
                wide[:, list(support)] = rows[:, :-1].numpy()
                extra = np.zeros((len(rows), len(labels)))
                for number, x in enumerate(builder.extras):
                    extra[:, labels.index((log.source if x.per_log else "", x.label))] = wide[:, count + number]
                blocks.append(np.hstack([wide[:, :count] @ M, extra]))
                right.append(rows[:, -1].numpy().copy())
    return np.vstack(blocks), np.concatenate(right), labels


@pytest.mark.parametrize("oversampling", [1.0, 7.0])
@pytest.mark.parametrize(
    "terms",
    [
        OFFSETS,
        ExtraTerms(
            offsets={"joint_torque": "all", "contact_moment": "log"}, scales={"contact_force": "log"}, armature=True
        ),
    ],
    ids=["offsets", "scales and actuators too"],
)
def test_eliminating_unknowns_is_solving_for_all_at_once(
    recorded: Recorded, terms: ExtraTerms, oversampling: float
) -> None:
    """Values, standard errors, rank and residual against numpy on the stacked rows of all logs with all columns."""
    robot, _, logs = recorded
    generator = torch.Generator().manual_seed(0)
    logs = [replace(noisy(log, robot, generator), oversampling=oversampling) for log in logs]
    found = fit(robot, CONTACTS, sensors_of(robot), terms, logs)
    X, y, labels = stacked(found.builder, robot, logs)
    free, scale = free_parameters(robot), found.assembly.problem.scale
    nominal = robot.nominal.flatten()
    units = np.append(scale[free], np.ones(len(labels)))
    columns = np.hstack([X[:, : len(free)][:, free], X[:, len(free) :]]) * units
    y = y - X[:, : len(free)] @ nominal
    norms = np.linalg.norm(columns, axis=0)
    _, values, Vt = np.linalg.svd(columns / norms, full_matrices=False)
    rank = int((values > 1e-9 * values[0]).sum())
    inverse = np.linalg.pinv(columns / norms, rcond=1e-9) / norms[:, None]
    step = inverse @ y
    residual = y - columns @ step
    noise = np.sqrt(oversampling * (residual @ residual) / (len(y) - oversampling * rank))
    assert found.estimate.rank == rank - len(labels)
    assert np.sqrt(oversampling) * found.estimate.residual_std == pytest.approx(noise, rel=1e-3)  # a rounded row count
    error = noise * np.linalg.norm(inverse, axis=1)
    assert {(x.log, x.extra.label) for x in found.extras} == set(labels)
    for x in found.extras:
        place = free.sum() + labels.index((x.log, x.extra.label))
        assert x.value == pytest.approx(step[place], rel=1e-8, abs=1e-8)
        assert x.standard_error == pytest.approx(error[place], rel=1e-3)
    known = found.estimate.identifiable
    expected = nominal.copy()
    expected[free] += step[: free.sum()] * scale[free]
    np.testing.assert_allclose(found.estimate.phi[known], expected[known], rtol=1e-7, atol=1e-7 * scale[known].max())
    errors = np.full(len(free), np.nan)
    errors[free] = error[: free.sum()] * scale[free]
    np.testing.assert_allclose(found.estimate.standard_error[known], errors[known], rtol=1e-3)


def slide(folder: Path) -> Robot:
    """A bolted column on which a carriage of 2 kg slides up and down."""
    limit = '<axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="9" velocity="9"/>'
    lift = joint("lift", "base", "arm", "prismatic", limit)
    return load(write(folder, BASE, link("arm", inertial("2")), lift), None, True)


@pytest.mark.slow("200 repetitions of noise")
def test_95_percent_intervals_of_offsets_hold_the_truth_that_often(tmp_path: Path) -> None:
    """200 repetitions, with the noise that is stated, of five short logs of a slide."""
    robot, rng = slide(tmp_path), np.random.default_rng(9)
    terms = ExtraTerms(offsets={"joint_torque": "log"})
    sensors = named_sensors("joints", robot.n, 0, NOISE)
    logs = [bind_log(make_log(Oracle.of(robot), [], [[]], 8, rng, f"{k}.npz"), robot, ()) for k in range(5)]
    generator, hits = torch.Generator().manual_seed(1), []
    for _ in range(200):
        found = fit(robot, (), sensors, terms, [noisy(log, robot, generator) for log in logs])
        hits += [abs(x.value) < 1.96 * x.standard_error for x in found.extras]
    assert len(hits) == 200 * len(logs)
    assert 0.93 < np.mean(hits) < 0.97


@pytest.mark.parametrize("acceleration", [0.0, 0.3, 0.9, 1.1, 3.0])
def test_an_offset_and_a_weight_are_as_far_apart_as_the_acceleration_is_from_constant(
    tmp_path: Path, acceleration: float
) -> None:
    """Of f = m (a + g) + o: the error of o grows by rms(a + g) / std(a) if m is not known."""
    robot, rng = slide(tmp_path), np.random.default_rng(4)
    a = acceleration * rng.choice([-1.0, 1.0], (200, 1))
    s = a + 9.81
    log = Log("lift.npz", np.arange(200) * 0.01, ("lift",), 0 * a, 0 * a, a, 2.0 * s + 7.0)
    sensors = named_sensors("joints", 1, 0)
    (found,) = fit(robot, (), sensors, ExtraTerms(offsets={"joint_torque": "all"}), [bind_log(log, robot, ())]).extras
    if acceleration:
        assert found.inflation == pytest.approx(np.sqrt((s**2).mean()) / a.std(), rel=1e-6)
        assert found.value == pytest.approx(7.0, abs=1e-6)
    assert found.separable == (acceleration > 9.81 / INFLATION_LIMIT)
    if not found.separable:
        assert found.confounded_with == ("arm m",)
        assert (found.standard_error == np.inf) == (acceleration == 0.0)
