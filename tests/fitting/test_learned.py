"""Rigid bodies with a learned module beside them: saved, loaded, evaluated, exported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from repository import DEMO
from script_calls import call

import torchid
from torchid import JointNetworks, RigidPlusResidual
from torchid.commands.export import export
from torchid.config.experiment import ActuatorsConfig
from torchid.errors import InputError


@pytest.fixture(scope="module")
def learned() -> RigidPlusResidual:
    """The demo's quadruped with networks of random output."""
    robot = torchid.load_robot(DEMO / "quadruped.urdf")
    torch.manual_seed(0)
    networks = JointNetworks(robot.n, 4)
    torch.nn.init.normal_(networks.out, std=0.3)
    return RigidPlusResidual(robot, 1.1 * robot.nominal.ravel(), networks)


def states(n: int) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(1)
    q, v, a = (torch.randn(5, size, dtype=torch.float64, generator=generator) for size in (n + 7, n + 6, n + 6))
    return q, v, a


def test_what_is_saved_loads_as_tensors_alone_and_gives_the_same_forces(
    learned: RigidPlusResidual, tmp_path: Path
) -> None:
    robot, path = torchid.load_robot(DEMO / "quadruped.urdf"), tmp_path / "residual.pt"
    learned.save(path)
    assert set(torch.load(path, weights_only=True)) == {"phi", "residual"}
    again = RigidPlusResidual.load(path, robot)
    state = states(robot.n)
    torch.testing.assert_close(again(*state), learned(*state), rtol=0.0, atol=0.0)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match="file: not readable") as caught:
        RigidPlusResidual.load(path, robot)
    assert "\n" not in str(caught.value)
    learned.save(path)
    with pytest.raises(InputError, match="for this robot and module"):
        RigidPlusResidual.load(path, robot, torch.nn.Linear(3, 3))


def test_a_run_with_networks_is_evaluated_with_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without friction in the model the networks find most of it, on a log that nothing has seen."""
    run, log = tmp_path / "run", DEMO / "sway_test.npz"
    terms = f"actuators={ActuatorsConfig.without_terms()}".replace("None", "null")
    more = ("estimator.friction=false", terms, "estimator.ridge=0.01", "--epochs", "12", "--weight", "0.01")
    status, printed, told = call("train_residual", str(DEMO / "quadruped.yaml"), *more, "--curves",
                                 str(tmp_path / "curves"), "--output", str(run))  # fmt: skip
    assert status == 0, told
    assert f"written to {run}" in printed
    evaluated = torchid.evaluate(run, [log])
    ((name, errors),) = evaluated.with_residual.items()
    plain = evaluated.metrics[name].identified
    without, beside = (x.rms_of("nullspace") for x in (plain, errors))
    assert without is not None
    assert beside is not None
    assert beside < 0.6 * without
    document = evaluated.to_dict()[name]["with_residual"]
    assert isinstance(document, dict)
    assert np.isfinite([x for x in document.values() if isinstance(x, float)]).all()
    with pytest.warns(torchid.TorchidWarning, match="For the learned module use torch.export"):
        export(run, "urdf")
