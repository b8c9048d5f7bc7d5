"""`scripts/concept_figures.py`: the figures of the page of concepts, and what that page says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from repository import DEMO, ROOT
from script_calls import script

import torchid
from torchid.commands.run_folder import Identification
from torchid.parameters import COULOMB, PER_BODY, VISCOUS
from torchid.report.figures import INTERVAL


def test_the_projection_leaves_noise_of_forces_that_nobody_measured(demo_result: Identification) -> None:
    time, before, after = script("concept_figures").unmeasured_forces(demo_result)
    assert before.shape == after.shape == (2, len(time))
    rms = np.sqrt(np.mean(np.square([before, after]), axis=2))
    assert rms[0, 0] == pytest.approx(9.81 * demo_result.mass.value, rel=0.05), "on the base: the weight"
    assert (rms[1] < 0.01 * rms[0]).all()


def test_as_many_intervals_hold_the_truth_as_the_page_says(demo_result: Identification) -> None:
    true = script("concept_figures").TRUE_FRICTION
    errors, phi = demo_result.estimate.standard_error.reshape(-1, PER_BODY)[1:], demo_result.phi[1:]
    off = [abs(phi[:, k] - true[name]) / errors[:, k] for name, k in (("fc", COULOMB), ("fv", VISCOUS))]
    assert np.sum(np.less(off, INTERVAL)) == 24
    assert "24 of the 24 intervals hold it" in " ".join((ROOT / "docs" / "concepts.md").read_text().split())


@pytest.mark.parametrize("feet", [("four", (0, 1, 2, 3)), ("two", (0, 3)), ("none", ())], ids=lambda feet: feet[0])
def test_sensor_sets_determine_as_many_base_parameters_as_the_page_says(
    demo_result: Identification, feet: tuple[str, tuple[int, ...]]
) -> None:
    robot, contacts = demo_result.experiment.robot, demo_result.experiment.contacts
    state = tuple(number in feet[1] for number in range(len(contacts)))
    ranks = []
    for name in ("contacts", "joints", "full"):
        sensors = torchid.named_sensors(name, robot.n, len(contacts))
        ranks.append(np.linalg.matrix_rank(torchid.structural_problem(robot, contacts, sensors, [state]).A))
    row = " | ".join(str(rank) for rank in ranks)
    assert f"| {feet[0]} | {row} |" in (ROOT / "docs" / "concepts.md").read_text()


def test_every_figure_of_the_page_is_there_and_is_drawn(
    demo_result: Identification, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = []
    monkeypatch.setattr(torchid, "identify", lambda file, output: files.append((file, output)) or demo_result)
    script("concept_figures").draw(tmp_path)
    assert files == [(DEMO / "quadruped.yaml", None)]
    drawn = {path.name for path in tmp_path.iterdir()}
    assert len(drawn) == 4
    pages = (ROOT / "docs" / "concepts.md").read_text() + (ROOT / "README.md").read_text().replace("(docs/", "(")
    assert all(f"({name})" in pages and (ROOT / "docs" / name).is_file() for name in drawn)
