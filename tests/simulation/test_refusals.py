"""A robot that cannot stand is refused: exit status 2, one line on standard error, nothing written."""

from __future__ import annotations

import multiprocessing
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from refusals import files_in, refusal
from simulated import BIPED, SHIPPED, SOLES

from torchid.cli import main
from torchid.config import load_simulation
from torchid.errors import InputError, about_file
from torchid.simulation import Recording, set_up_simulation

FEET = [{"frame": sole} for sole in SOLES]
SQUAT = {"name": "m", "duration_s": 0.5, "waves": [{"what": "com_z", "hz": 1.0, "amplitude": 0.02}]}
ONE_POINT = [[0.0, 0.0, 0.0]]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A simulation file that would run, and its robot; also the working folder."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(BIPED, tmp_path / "biped.urdf")
    posture = yaml.safe_load(SHIPPED.read_text())["posture"]
    settings = {"robot": {"urdf": "biped.urdf"}, "feet": FEET, "posture": posture, "motions": [SQUAT], "output": "out"}
    (tmp_path / "sim.yaml").write_text(yaml.safe_dump(settings))
    return tmp_path


def moved(**changes: Any) -> dict[str, Any]:
    return {"motions": [SQUAT | changes]}


def wave(what: str, amplitude: float, **more: Any) -> dict[str, Any]:
    return moved(waves=[{"what": what, "hz": 1.0, "amplitude": amplitude, **more}])


def steps(*order: str, hz: float = 0.2, **settings: float) -> dict[str, Any]:
    return moved(duration_s=3.0, steps={"hz": hz, "order": list(order), **settings})


def feet(*points: list[list[float]] | None, frames: tuple[str, ...] = SOLES) -> dict[str, Any]:
    given = zip(frames, points or [None] * len(frames), strict=False)
    return {"feet": [{"frame": frame} | ({} if where is None else {"points": where}) for frame, where in given]}


SETTINGS: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "unknown foot": (feet(frames=("l_sol", "r_sole")), ("sim.yaml: feet: ", "l_sol")),
    "unknown foot with points": (feet(ONE_POINT, frames=("l_sol", "r_sole")), ("feet: unknown name 'l_sol'", "l_sole")),
    "foot that nothing touches": (
        feet(frames=("l_foot", "r_sole")),
        (
            "sim.yaml: feet: l_foot has no points here and no collision spheres in biped.urdf",
            "points: [[x, y, z], ...]",
        ),
    ),
    "no foot": ({"feet": []}, ("feet: an empty list",)),
    "posture of an unknown joint": (
        {"posture": {"l_nee_flexion": 1.0}},
        ("sim.yaml: posture: unknown name 'l_nee_flexion'; accepted: l_knee_flexion",),
    ),
    "posture that does not stand": ({"posture": {"l_hip_flexion": -1.5}}, ("posture: l_sole is 86 deg off",)),
    "unknown wave": (wave("com_w", 0.1), ("motions.m.waves.0.what: unknown name 'com_w'", "com_x")),
    "unknown key of a wave": (wave("com_z", 0.1, hertz=1.0), ("motions.0.waves.0: unknown name 'hertz'", "hz")),
    "unknown foot to lift": (steps("r_sole", "l_foot"), ("motions.m.steps.order: unknown name 'l_foot'", "l_sole")),
    "two motions of one name": ({"motions": [SQUAT, SQUAT]}, ("motions: several named 'm'",)),
    "name that is no file name": (moved(name="a/b"), ("motions.0.name: found 'a/b'",)),
    "no motion": ({"motions": []}, ("motions: an empty list",)),
    "control between two steps": (
        {"control_hz": 300},
        ("control_hz: 300; accepted: 1000 / a whole number",),
    ),
    "control faster than physics": ({"control_hz": 2000}, ("control_hz: 2000",)),
    "unknown key": ({"sensors": {"noice": {}}}, ("sensors: unknown name 'noice'; accepted: noise",)),
    "unknown key at the top": ({"foot": FEET}, ("key: unknown name 'foot'", "feet")),
    "nominal robot of no mass": ({"nominal": {"error": 1.0}}, ("nominal.error: found 1.0",)),
    "no robot": ({"robot": {"urdf": "nowhere.urdf"}}, ("nowhere.urdf", "no such file")),
}


def refused(folder: Path, capsys: pytest.CaptureFixture[str], *overrides: str) -> str:
    """The one line with which a simulation ends that leaves everything as it was."""
    return refusal(["simulate", str(folder / "sim.yaml"), *overrides], folder, capsys)


def simulated(file: Path) -> Recording:
    """The first motion of a file, in this process."""
    config = load_simulation(file)
    with about_file(file):
        return set_up_simulation(config).run(config.motions[0])[0]


def edit(folder: Path, changes: dict[str, Any]) -> None:
    settings = yaml.safe_load((folder / "sim.yaml").read_text())
    (folder / "sim.yaml").write_text(yaml.safe_dump(settings | changes))


@pytest.mark.parametrize(("changes", "expected"), SETTINGS.values(), ids=SETTINGS.keys())
def test_a_simulation_that_makes_no_sense_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], expected: tuple[str, ...]
) -> None:
    edit(folder, changes)
    line = refused(folder, capsys)
    for part in expected:
        assert part in line


URDFS = {
    "negative mass": ('<mass value="11"', '<mass value="-11"', ("pelvis", "-11 kg")),
    "spheres of no size": ('<sphere radius="0.01"', '<sphere radius="0"', ("'l_sole', <sphere>: radius 0",)),
    "planar joint": ('type="revolute"', 'type="planar"', ("torso_roll", "planar")),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "expected"), URDFS.values(), ids=URDFS.keys())
def test_a_robot_that_cannot_be_simulated_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected: tuple[str, ...]
) -> None:
    text = (folder / "biped.urdf").read_text()
    assert old in text
    (folder / "biped.urdf").write_text(text.replace(old, new))
    line = refused(folder, capsys)
    for part in expected:
        assert part in line


NOTHING_TO_STAND_ON: dict[str, dict[str, Any]] = {
    "biped on two points": feet(ONE_POINT, ONE_POINT),
    "only foot lifted": feet(frames=("l_sole",)) | steps("l_sole", hz=0.5, swing_s=1.0),
    "motion without a sample": moved(duration_s=1e-9),
}


@pytest.mark.parametrize("changes", NOTHING_TO_STAND_ON.values(), ids=NOTHING_TO_STAND_ON.keys())
def test_a_robot_that_has_nothing_to_stand_on_is_refused(folder: Path, changes: dict[str, Any]) -> None:
    edit(folder, changes)
    with pytest.raises(InputError, match="sim.yaml: "):
        simulated(folder / "sim.yaml")


# ----------------------------------------------------------------------------------------------- while the robot moves


def test_a_robot_that_falls_is_refused_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half a metre sideways; the error crosses from the process that simulated it."""
    edit(folder, wave("com_y", 0.5))
    assert "sim.yaml: motions.m: the robot falls 1." in refused(folder, capsys)
    assert multiprocessing.active_children() == []


def test_a_robot_that_keeps_standing_but_not_within_the_bounds_is_refused(folder: Path) -> None:
    edit(folder, {"bounds": {"zmp_m": 0.5}})
    with pytest.raises(InputError, match="sim.yaml: motions.m: the ZMP is .* wider bounds"):
        simulated(folder / "sim.yaml")


def test_an_interrupted_simulation_leaves_neither_files_nor_processes(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        assert multiprocessing.active_children() != []
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("torchid.commands.simulate.wait", interrupted)
    before = files_in(folder)
    assert main(["simulate", str(folder / "sim.yaml")]) == 1
    assert capsys.readouterr().err == "torchid: interrupted; nothing was written\n"
    assert files_in(folder) == before
    assert multiprocessing.active_children() == []


def test_without_mujoco_a_simulation_says_how_to_install_it(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.startswith("torchid.simulation") or name in ("torchid.commands.simulate", "torchid.robot.mjcf"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    line = refusal(["simulate", str(folder / "sim.yaml")], folder, capsys)
    assert line.endswith("MuJoCo, which is not installed; accepted: pip install '.[sim]' in the clone of torchid")
