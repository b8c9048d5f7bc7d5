"""What a GPU computes is what the CPU computes: rows, factors, gradients, whole commands, samples of a posterior."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from random_samples import random_samples, sensor_set
from shared_work import TWO, differences, finish, write_experiments
from synthetic import G1, PANDA, SOLO12, TALOS, load, random_states
from torch import Tensor

import torchid
from torchid.cli import main
from torchid.problem import RowBuilder, compress
from torchid.problem.linear import parameter_scale
from torchid.regressor import FrameJacobian, Regressor
from torchid.sensing import Contact

GPU = torch.device("cuda")
pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use"),
    pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning"),
]
ROBOTS = {
    "quadruped": (SOLO12, False, tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))),
    "balls": (SOLO12, False, tuple(Contact(f"{leg}_FOOT", "point", radius=0.03) for leg in ("FL", "FR", "HL", "HR"))),
    "humanoid": (G1, False, tuple(Contact(f"{side}_ankle_roll_link", "flat") for side in ("left", "right"))),
    "bolted arm": (PANDA, True, (Contact("panda_hand", "line", "x"),)),
}
DESCENT = ("estimator.name=sgd", "estimator.training.epochs=4", "estimator.ridge=0.1")
RUNS = {
    "biped": ("biped", ()),
    "biped, consistent": ("biped", ("estimator.name=consistent",)),
    "arm, robust": ("arm", ("estimator.robust=tukey",)),
    "arm, ridge": ("arm", ("estimator.ridge=auto",)),
    "quadruped, descent": ("quadruped", DESCENT),
}


def unlike(found: Tensor, expected: Tensor) -> float:
    """Largest difference, by the largest number expected."""
    return float((found.cpu() - expected).abs().max() / expected.abs().max())


@pytest.mark.parametrize("urdf", [SOLO12, G1, TALOS])
def test_the_regressor_and_its_gradients(urdf: Path) -> None:
    robot = load(urdf)
    state = [torch.from_numpy(x) for x in random_states(np.random.default_rng(0), robot.n, 33)]
    frame = robot.bodies[-1].name

    def work(device: torch.device) -> tuple[Tensor, Tensor, list[Tensor]]:
        q, v, a = (x.to(device).requires_grad_() for x in state)
        K, J = Regressor(robot).to(device)(q, v, a), FrameJacobian(robot, frame).to(device)(q)
        (K.square().sum() + J.square().sum()).backward()
        return K.detach(), J.detach(), [x.grad for x in (q, v, a) if x.grad is not None]

    for found, expected in zip(work(GPU), work(torch.device("cpu")), strict=True):
        pairs = zip(found, expected, strict=True) if isinstance(found, list) else [(found, expected)]
        for one, other in pairs:
            assert one.device.type == "cuda"
            assert unlike(one, other) < 1e-13


@pytest.mark.parametrize("sensors", ["joints", "contacts", "full", "mixed"])
@pytest.mark.parametrize("name", ROBOTS)
def test_rows_and_factors(name: str, sensors: str) -> None:
    urdf, bolted, contacts = ROBOTS[name]
    robot = load(urdf, None, bolted)
    if bolted and sensors == "contacts":
        sensors = "mixed"
    samples, _ = random_samples(robot, contacts, 6000, 1, states=3)
    builder = RowBuilder(robot, contacts, sensor_set(sensors, robot, contacts))
    expected = compress([samples], builder, chunk=1000).triangle()
    there = builder.to(GPU)
    for chunk in (700, None):
        found = compress([samples], there, chunk=chunk).triangle().cpu()
        assert unlike(found.T @ found, expected.T @ expected) < 1e-12


@pytest.fixture(scope="module")
def experiments(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_experiments(tmp_path_factory.mktemp("experiments"))


def assert_same(there: Path, here: Path, experiment: Path, tolerance: float) -> None:
    """Parameters in units of their scale, and the figures of the fit.

    A descent lets rounding grow: Adam divides gradients that are nearly zero by their size.
    """
    identified = []
    for run in (there, here):
        bodies = json.loads((run / "parameters.json").read_text())["bodies"]
        identified.append(np.array([[*body["identified"].values()] for body in bodies]))
    robot = yaml.safe_load(experiment.read_text())["robot"]
    scale = parameter_scale(torchid.load_robot(robot["urdf"], fixed_base=robot["fixed_base"]).nominal)
    assert float(np.abs((identified[0] - identified[1]) / scale).max()) < tolerance
    one, other = (json.loads((run / "metrics.json").read_text()) for run in (there, here))
    for group in ("train", "train_nominal", "cross_validation", "robust", "samples", "rows"):
        for where, difference in differences(one[group], other[group], group):
            assert difference < 100.0 * tolerance, where


@pytest.mark.parametrize("name", RUNS)
def test_whole_runs(name: str, experiments: dict[str, Path], tmp_path: Path) -> None:
    robot, more = RUNS[name]
    file = experiments[robot]
    for device in ("cuda", "cpu"):
        assert main(["identify", str(file), f"output={tmp_path / device / 'run'}", f"device={device}", *more]) == 0
    assert_same(tmp_path / "cuda/run", tmp_path / "cpu/run", file, 1e-7 if DESCENT[0] in more else 1e-9)


def test_two_processes_share_a_gpu(experiments: dict[str, Path], tmp_path: Path) -> None:
    file = experiments["biped"]
    status, _, complained = finish(
        [*TWO, "-m", "torchid", "identify", str(file), f"output={tmp_path / 'two/run'}", "device=cuda"]
    )
    assert status == 0, complained
    assert main(["identify", str(file), f"output={tmp_path / 'one/run'}", "device=cpu"]) == 0
    assert_same(tmp_path / "two/run", tmp_path / "one/run", file, 1e-9)
