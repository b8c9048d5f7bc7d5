"""What a thing says of itself, in ten lines at most."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch
from demo import shortened_demo
from repository import DEMO

import torchid
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.reprs import REPR_LINES, short_repr

FILE = DEMO / "quadruped.yaml"


@pytest.fixture(scope="module")
def things(demo_result: torchid.Identification, tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, object]:
    """One of each public building block, of the demo; what is checked and analyzed is short."""
    short = shortened_demo(tmp_path_factory.mktemp("short") / "demo", 200) / "quadruped.yaml"
    log, robot = torchid.read_log(DEMO / "sway_train.npz"), torchid.load_robot(DEMO / "quadruped.urdf")
    contacts = [torchid.Contact(name, "point") for name in log.contact_names]
    noise = torchid.SensorNoise(joint_torque=0.1)
    sensors = torchid.named_sensors("joints", robot.n, len(contacts), noise)
    builder = torchid.RowBuilder(robot, contacts, sensors)
    samples = replace(torchid.bind_log(torchid.preprocess(log, 8.0), robot, contacts), motion_noise=None)
    factor = torchid.compress([samples], builder)
    problem = torchid.linear_problem(factor, builder, robot)
    fitter = torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares())
    parts = torchid.compress_parts([samples], builder)
    fit = fitter.fit(parts)
    batches = torchid.MiniBatches([samples], builder)
    analysis = torchid.analyze(short, output=None, estimator={"ridge": 0.01})
    checked = torchid.check(short)
    return {
        "log": log,
        "filtered log": torchid.preprocess(log, 8.0),
        "samples": samples,
        "robot": robot,
        "body": robot.bodies[3],
        "contact": contacts[0],
        "noise": noise,
        "sensors": sensors,
        "rows": builder,
        "regressor": torchid.Regressor(robot),
        "jacobian": torchid.FrameJacobian(robot, "trunk"),
        "loops": torchid.LoopJacobian(robot),
        "projection": torchid.Projection([True, False], [False]),
        "projected group": torchid.Projection([True] * robot.n, [])(*_no_contacts(robot))[0],
        "factor": factor,
        "part": parts[0],
        "compressed log": torchid.compress_log(samples, builder),
        "problem": problem,
        "extra terms": torchid.ExtraTerms(),
        "least squares": torchid.LeastSquares(ridge=1e-3),
        "consistent": torchid.Consistent(conditions=torchid.Conditions()),
        "conditions": torchid.Conditions(),
        "sgd": torchid.Sgd(),
        "log-Cholesky": torchid.LogCholeskyParameters(problem),
        "batches": batches,
        "trainer": torchid.Trainer(torchid.Sgd(epochs=3), problem, batches),
        "estimate": fit.estimate,
        "consistent estimate": torchid.Consistent(ridge=1e-3, conditions=torchid.Conditions()).solve(problem),
        "fitter": fitter,
        "fit": fit,
        "calibration": torchid.calibrations(fit, robot, builder).identified,
        "noise summary": torchid.estimate_noise([samples], fitter),
        "base parameters": torchid.base_parameters(problem),
        "loss": torchid.RobustLoss.named("huber", 1.345, 5),
        "experiment": set_up(load_config(FILE)),
        "identification": demo_result,
        "metrics": demo_result.metrics["test"].identified,
        "body estimate": demo_result["trunk"],
        "body values": demo_result["trunk"].nominal,
        "verdicts": demo_result["trunk"].verdict,
        "table": demo_result.table(),
        "evaluation": torchid.evaluate(demo_result, DEMO / "sway_test.npz"),
        "analysis": analysis,
        "scenario": analysis.scenarios[0],
        "checked logs": checked,
        "checked log": checked[0],
    }


def _no_contacts(robot: torchid.Robot) -> tuple[torch.Tensor, ...]:
    """A batch in the air, to project."""
    J, K = torch.zeros(5, 0, robot.nv, dtype=torch.float64), torch.ones(5, robot.nv, 2, dtype=torch.float64)
    return J, torch.zeros(5, 0, dtype=torch.bool), K, K[:, 6:, 0], J[:, :, 0]


def test_no_repr_is_longer_than_ten_lines(things: Mapping[str, object]) -> None:
    for name, thing in things.items():
        lines = repr(thing).splitlines()
        assert 1 <= len(lines) <= REPR_LINES, name
        assert max(map(len, lines)) <= 200, name
        assert " object at 0x" not in repr(thing), name


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("log", "sway_train.npz, 1300 samples in 12.99 s"),
        ("log", "joint_torque (1300, 12)"),
        ("robot", "Robot: quadruped.urdf, 13 bodies, 20.800 kg, floating base trunk, 12 joints front_left_hip, "),
        ("sensors", "12 joint torques"),
        ("rows", "RowBuilder: 4 contacts, 118 columns"),
        ("regressor", "13 bodies, 12 joints, 18 rows of K"),
        ("problem", "for 156 parameters (154 free)"),
        ("estimate", "Estimate: rank 118 of 156 parameters (79 identified, "),
        ("base parameters", "118 base parameters from 156 parameters (154 free)"),
        ("batches", "MiniBatches: 1250 samples of 1 log"),
        ("trainer", "Trainer: epoch 0 of 3"),
        ("identification", "Identification of quadruped.urdf, 13 bodies, 12 joints, by consistent"),
        ("identification", "data        1250 samples of 1 log"),
        ("identification", "total mass  21.435 ± 0.15 kg (URDF: 20.800 kg; 1 sigma, with 2 % gain error)"),
        ("identification", "written to  no folder"),
        ("body estimate", "± 0.025 kg m, identified"),
        ("metrics", "Metrics: joint torque 0.0725 N m (6.8 %), base force 0.616 N (0.51 %), base moment 0.146 N m"),
        ("evaluation", "sway_test: joint torque 0.362 -> 0.0725 N m"),
        ("analysis", "cost 12"),
        ("checked logs", "2 logs checked, 2 usable"),
    ],
)
def test_a_repr_says_what_the_thing_is(things: Mapping[str, object], name: str, said: str) -> None:
    assert said in " ".join(repr(things[name]).split()) or said in repr(things[name])


def test_what_says_nothing_is_left_out_and_what_is_long_is_cut() -> None:
    field = torchid.Log(source="x", time=np.zeros(1), joint_names=("a",), joint_position=np.zeros((1, 1)))
    assert "joint_torque" not in repr(field)
    many = torchid.Conditions(names=tuple(f"body{number}" for number in range(1000)))
    assert "and 996 more" in repr(many)
    assert len(repr(many).splitlines()) <= 2
    assert short_repr(torch.zeros(3)) == "Tensor()"
