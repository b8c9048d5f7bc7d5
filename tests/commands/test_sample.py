"""`torchid sample`: what it writes, and what it refuses."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demo import DEMO, FAST_ESTIMATOR, NO_TERMS

import torchid
from torchid.cli import main
from torchid.commands.sample import sample
from torchid.errors import ConfigError
from torchid.fitting.posterior import POSTERIOR
from torchid.parameters import consistency_margin
from torchid.terminal.identification import sample_lines

pytestmark = pytest.mark.filterwarnings("ignore:identified:torchid.errors.TorchidWarning")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of least squares, whose own estimate has bodies that cannot exist."""
    output = tmp_path_factory.mktemp("sample") / "run"
    torchid.identify(
        DEMO / "quadruped.yaml", estimator=FAST_ESTIMATOR, actuators=NO_TERMS | {"armature": True}, output=output
    )
    return output


def test_npz_has_names_and_bodies_that_exist(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "s.npz"
    assert main(["sample", str(run), "--count", "500", "--output", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "500 physically consistent robots" in printed
    assert max(map(len, printed.splitlines())) <= 100
    with np.load(out) as arrays:
        samples, names = arrays["samples"], arrays["names"].tolist()
        assert samples.shape == (500, 13 * 12 + 12) == (500, len(names)) == (500, len(arrays["units"]))
    phi = samples[:, :156].reshape(500, 13, 12)
    assert (consistency_margin(phi) > 0.0).all()
    assert (phi[..., 10:] >= 0.0).all()
    assert (samples[:, names.index("armature of front_left_knee")] > 0.0).all()
    assert names[0] == "trunk.m"


def test_robots_are_the_samples(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    drawn = sample(run, 3, "npz", tmp_path / "s.npz", seed=7)
    with pytest.warns(torchid.TorchidWarning, match="the armature of"):
        sample(run, 3, "urdf", tmp_path / "urdf", seed=7)
    sample(run, 3, "mjcf", tmp_path / "mjcf", seed=7)
    for number in range(3):
        for form, suffix in (("urdf", "urdf"), ("mjcf", "xml")):
            robot = torchid.load_robot(tmp_path / form / f"quadruped_{number}.{suffix}")
            np.testing.assert_allclose(robot.nominal, drawn.samples.phi[number], rtol=0.0, atol=1e-10)
        armature = [float(x[number]) for x in drawn.samples.of_joints("armature").values()]
        np.testing.assert_allclose(robot.armature, armature)


def test_ranges_and_correlations_are_those_of_the_samples(run: Path, tmp_path: Path) -> None:
    drawn = sample(run, 2000, output=tmp_path / "r.json")
    document = json.loads((tmp_path / "r.json").read_text())
    mass = drawn.samples.mass[:, 0].numpy()
    entry = document["parameters"]["trunk.m"]
    np.testing.assert_allclose(entry["quantiles"], np.quantile(mass, document["quantiles"]))
    assert entry["nominal"] == 11.0
    names = document["correlations"]["names"]
    matrix = np.array(document["correlations"]["matrix"])
    first, other = names.index("trunk.m"), names.index("trunk.mcx")
    expected = np.corrcoef(mass, drawn.samples.phi[:, 0, 1])[0, 1]
    np.testing.assert_allclose(matrix[first, other], expected, atol=1e-4)
    np.testing.assert_allclose(np.diag(matrix), 1.0, atol=1e-4)
    assert "trunk.fc" not in names  # the base has no joint


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--count", "0"], "--count: 0; accepted: 1 to 200000"),
        (["--prior-error", "-1"], "--prior-error: -1; accepted: a number above 0, at most 100, or auto"),
        (["--prior-error", "wide"], "--prior-error: 'wide'; accepted: a number above 0, at most 100, or auto"),
        (["--seed", "-1"], "--seed: -1; accepted"),
        (["--output", "x.txt"], "'x.txt' has no known extension; accepted: FILE.npz"),
        (["--output", "x.txt", "--format", "npz"], "'x.txt'; accepted: FILE.npz"),
        (["--output", "no/such/folder.npz"], "the folder no/such does not exist"),
    ],
)
def test_mistakes_end_in_one_line(
    run: Path, options: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sample", str(run), *options]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1


def test_runs_without_a_posterior_are_refused_with_advice(run: Path, tmp_path: Path) -> None:
    old = tmp_path / "old"
    shutil.copytree(run, old)
    (old / POSTERIOR).unlink()
    with pytest.raises(torchid.TorchidError, match=r"no posterior\.npz in it; accepted: a run folder of this version"):
        sample(old)
    with pytest.raises(ConfigError, match=r"config\.yaml is missing"):
        sample(tmp_path)
    with pytest.raises(torchid.TorchidError, match="none: RUN: no such file or folder; accepted: a run folder of this"):
        torchid.PosteriorSampler(tmp_path / "none")


def test_the_answer_says_that_the_prior_is_too_narrow_and_what_fits(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = sample(run, 20)
    posterior = drawn.fitted.posterior
    light = posterior.nominal.copy()
    light.reshape(-1, 12)[:, :10] *= 0.3  # bodies weigh three times what their file says
    wrong = replace(drawn, fitted=replace(drawn.fitted, posterior=replace(posterior, nominal=light)))
    assert drawn.fitted.nominal_error is not None
    assert "too narrow" not in " ".join(sample_lines(drawn, 100))
    text = " ".join(" ".join(sample_lines(wrong, 100)).split())
    found = wrong.fitted.nominal_error
    assert found is not None
    assert found.value > 0.6
    assert f"the bodies that the data determine differ from the robot file by {100.0 * found.value:.0f} %" in text
    assert "--prior-error auto" in text


def test_files_that_stand_there_stay_without_overwrite(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "s.npz"
    sample(run, 5, output=out)
    before = out.read_bytes()
    with pytest.raises(ConfigError, match="--overwrite"):
        sample(run, 6, output=out)
    assert out.read_bytes() == before
    sample(run, 6, output=out, overwrite=True)
    with np.load(out) as arrays:
        assert len(arrays["samples"]) == 6
