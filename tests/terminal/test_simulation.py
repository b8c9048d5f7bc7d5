"""What `torchid simulate` says on one screen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from simulated import shipped

from torchid.config import SimulationConfig
from torchid.report.tables import LINES
from torchid.simulation import Stability
from torchid.terminal.simulations import simulation_lines

STANDS = Stability((0.622, 0.835), 0.001, 0.0002, 0.076, 0.0, 0.01, (0.0, 0.33))


def motions(names: list[str]) -> tuple[SimulationConfig, dict[str, Stability]]:
    """A simulation that has motions of such names, and how the robot stood: the later the worse."""
    config = shipped(Path("runs/biped"))
    found = [replace(config.motions[0], name=name, duration_s=10.0) for name in names]
    stood = {name: replace(STANDS, zmp_margin=0.1 / (1 + k)) for k, name in enumerate(names)}
    return replace(config, motions=found), stood


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("count", [1, 13, 50])
def test_any_number_of_motions_fits_on_a_screen(count: int, width: int) -> None:
    config, stood = motions([f"squat_{k}" for k in range(count)])
    lines = simulation_lines(config, stood, width)
    assert len(lines) <= LINES
    assert lines[-1] == f"written to    {config.output}"
    assert max(map(len, lines[:-1])) <= width
    shown = [line.split()[0] for line in lines if line.startswith("squat_")]
    assert shown == [f"squat_{k}" for k in range(count)[::-1]][: len(shown)], "the nearest to a bound first"
    if len(shown) < count:
        assert f"and {count - len(shown)} more motions: --verbose" in lines
    assert len(shown) >= min(count, 11)


def test_the_worst_of_all_motions_comes_first_in_words() -> None:
    config, stood = motions(["squat", "sway"])
    stood["squat"] = replace(stood["squat"], slip=0.0031, effort=0.62)
    said = " ".join(" ".join(simulation_lines(config, stood, 80)).split())
    assert said.startswith(
        "The robot stands during 2 motions (20 s): feet slip at most 3.1 mm, "
        "the zero-moment point stays 50 mm inside the support, torques reach 62 % of their limits"
    )
