"""`torchid simulate` from file to folder: what it writes, that it repeats itself, and that it serves identification."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from refusals import files_in
from simulated import BIPED, SHIPPED, SQUATS, SWAYS, UNSEEN, only, short
from synthetic import load

from torchid import parameters
from torchid.cli import main
from torchid.config import FootConfig, dump_config, load_simulation
from torchid.simulation.plant import find_feet

MOTIONS = (*SQUATS, *SWAYS, UNSEEN)
ALONE = SQUATS[-1]


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulation file of one motion of the short set, that has not run."""
    folder = tmp_path_factory.mktemp("alone")
    (folder / "sim.yaml").write_text(dump_config(only(short(folder / "out"), ALONE)))
    return folder / "sim.yaml"


def test_a_simulation_folder_holds_what_it_promises(biped_folder: Path) -> None:
    names = {path.name for path in biped_folder.iterdir()}
    assert names == {"logs", "exact", "nominal.urdf", "stability.json", "simulation.yaml", "manifest.json"}
    for kind in ("logs", "exact"):
        assert {path.name for path in (biped_folder / kind).iterdir()} == {f"{name}.npz" for name in MOTIONS}
    assert [path.name for path in biped_folder.parent.iterdir()] == [biped_folder.name], "temporary folders left behind"


def test_the_resolved_simulation_reads_back_as_itself(biped_folder: Path) -> None:
    assert load_simulation(biped_folder / "simulation.yaml") == short(biped_folder)


def test_the_nominal_robot_is_the_true_one_with_other_inertias_and_could_exist(biped_folder: Path) -> None:
    true, nominal = load(BIPED), load(biped_folder / "nominal.urdf")
    assert nominal.joint_names == true.joint_names
    expected = parameters.perturb_parameters(true.nominal, 0.2, np.random.default_rng(0))
    np.testing.assert_allclose(nominal.nominal, expected, rtol=1e-9, atol=1e-12)
    ratio = nominal.nominal[:, 0] / true.nominal[:, 0]
    assert np.abs(ratio - 1.0).max() < 0.2
    assert np.abs(ratio - 1.0).max() > 0.1
    assert (parameters.consistency_margin(nominal.nominal) > 0.0).all()
    for sole in ("l_sole", "r_sole"):
        found, shipped = (find_feet([FootConfig(sole)], p) for p in (biped_folder / "nominal.urdf", BIPED))
        assert found == shipped


def test_the_same_seed_writes_the_same_logs_bit_for_bit_and_another_changes_the_noise_alone(
    biped_folder: Path, alone: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Alone as among others; the second run replaces the first."""
    output = alone.parent / "out"
    assert main(["simulate", str(alone)]) == 0
    printed = capsys.readouterr()
    assert ALONE in printed.out
    assert f"written to    {output}" in printed.out
    assert printed.err == ""
    first = files_in(output)
    for kind in ("exact", "logs"):
        assert first[f"{kind}/{ALONE}.npz"] == (biped_folder / kind / f"{ALONE}.npz").read_bytes()
    assert first["nominal.urdf"] == (biped_folder / "nominal.urdf").read_bytes()

    assert main(["simulate", str(alone), "seed=1", "overwrite=true"]) == 0
    second = files_in(output)
    assert second.keys() == first.keys()
    changed = {name for name in first if second[name] != first[name]}
    assert changed == {f"logs/{ALONE}.npz", "simulation.yaml", "manifest.json"}
    assert sorted(path.name for path in alone.parent.iterdir()) == ["out", "sim.yaml"]


@pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")
def test_the_logs_identify_the_robot_from_its_joint_torques_alone(
    biped_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The shipped experiment on seconds of every motion; the unseen motion's torques are predicted better after."""
    logs = biped_folder / "logs"
    overrides = (
        f"robot.urdf={biped_folder / 'nominal.urdf'}",
        f"logs.train=[{logs}/squat_*.npz, {logs}/sway_*.npz]",
        f"logs.test=[{logs / UNSEEN}.npz]",
        f"output={tmp_path / 'run'}",
    )
    assert main(["identify", str(SHIPPED.parent / "biped_joints.yaml"), *overrides]) == 0, capsys.readouterr().err
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    for group in ("joint_torque_rms", "base_force_rms", "nullspace_rms"):
        assert metrics["test"][group] < 0.7 * metrics["test_nominal"][group], group
    trained = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["logs"]["train"]
    assert trained == [str(logs / f"{name}.npz") for name in (*SQUATS, *SWAYS)]


def test_shipped_experiments_read_the_logs_that_the_shipped_simulation_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their patterns match every training motion and no other; the paths are the simulation's output in the clone."""
    monkeypatch.chdir(SHIPPED.parents[1])
    config = load_simulation(SHIPPED)
    assert [motion.name for motion in config.motions] == list(MOTIONS)
    for name in ("full", "contacts", "joints", "reduced"):
        file = SHIPPED.parent / f"biped_{name}.yaml"
        settings = yaml.safe_load(file.read_text())
        assert (file.parent / settings["robot"]["urdf"]).resolve() == config.output / "nominal.urdf"
        patterns = [(file.parent / path).resolve() for path in settings["logs"]["train"]]
        matched = [motion.name for motion in config.motions
                   if any((config.output / "logs" / f"{motion.name}.npz").match(str(x)) for x in patterns)]  # fmt: skip
        assert matched == [*SQUATS, *SWAYS]
        assert [Path(path).stem for path in settings["logs"]["test"]] == [UNSEEN]
        assert [contact["frame"] for contact in settings["contacts"]] == [foot.frame for foot in config.feet]
