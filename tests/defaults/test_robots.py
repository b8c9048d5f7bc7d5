"""Robots that judge the defaults: their truth is exact, their flaws are of the size that is stated, seeds repeat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from defaults.making import make
from defaults.robots import CASES, Case, Held
from defaults.scoring import Score, Truth
from defaults.sensors import RINGING, Drawn, Flaws
from defaults.truth import serial_arm, write_given, write_true
from legged.robots import QUADRUPED
from scipy.signal import periodogram
from script_calls import call

from torchid.logs import Log
from torchid.robot import load_robot

ARM = Case(CASES["arm3"].urdf, Held(armature=(0.02, 0.05)), Flaws(gain=0.0), seconds=(2.0, 2.0), rate=200.0)
LEGGED = Case(QUADRUPED.urdf, QUADRUPED, Flaws(gain=0.0), seconds=(0.8, 1.2), imu="trunk")
KINDS = {
    "arm": ARM,
    "arm in MuJoCo": replace(ARM, integrator="implicitfast"),
    "steps": LEGGED,
    "walk": replace(LEGGED, integrator="implicitfast"),
}


def scored(folder: Path, kind: str) -> tuple[Truth, Score]:
    make(kind, 0, folder, KINDS)
    truth = Truth(folder / kind)
    return truth, truth.best_known()


@pytest.mark.parametrize("kind", KINDS)
def test_the_true_robot_predicts_its_unseen_motion(kind: str, tmp_path: Path) -> None:
    truth, score = scored(tmp_path, kind)
    sticks = KINDS[kind].integrator is not None  # dry friction of joints that rest is no function of their velocity
    assert score.torque < (0.2 * score.urdf_torque if sticks else 1e-6)
    if truth.floating:
        assert score.force is not None
        assert score.urdf_force is not None
        assert score.force < 1e-5 * score.urdf_force
    assert max(score.limbs.values()) < 1e-9
    assert (score.lightest[0], score.heaviest[0], score.mass) == pytest.approx((1.0, 1.0, 0.0), abs=1e-12)


def test_true_bodies_can_exist_and_are_a_fifth_off(tmp_path: Path) -> None:
    given = write_given(serial_arm("rods", (0.3,) * 6, (2.0,) * 6, "zyxzyx"), tmp_path)
    write_true(given, np.random.default_rng(0), 0.2, None)
    nominal, true = (load_robot(tmp_path / f"{name}.urdf", fixed_base=True).nominal for name in ("robot", "true"))
    off = true[1:, 0] / nominal[1:, 0] - 1.0
    assert np.abs(off).max() <= 0.2
    assert off.std() > 0.05
    for m, *moment, xx, xy, xz, yy, yz, zz in true[1:, :10]:
        about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        second = 0.5 * np.trace(about) * np.eye(3) - about
        pseudo = np.block([[second, np.array(moment)[:, None]], [np.array(moment)[None], np.array([[m]])]])
        assert np.linalg.eigvalsh(pseudo).min() > 0.0


def sines(count: int = 20_000, step: float = 1e-3) -> Log:
    time = step * np.arange(count)
    angle = np.sin(3.0 * time)[:, None] * [1.0, 2.0]
    return Log(
        "sines",
        time=time,
        joint_names=("a", "b"),
        joint_position=angle,
        joint_velocity=np.gradient(angle, step, axis=0),
        joint_acceleration=-9.0 * angle,
        joint_torque=5.0 * angle,
    )


def test_a_structure_rings_at_its_frequency_with_the_stated_acceleration() -> None:
    log, rng = sines(), np.random.default_rng(0)
    drawn = Drawn.of(Flaws(ringing="strong", band=(20.0, 40.0)), log, np.ones(2), rng)
    place, speed, torque = drawn.ringing(np.asarray(log.joint_torque), 1e-3, rng)
    acceleration = np.gradient(speed, 1e-3, axis=0)
    size = acceleration.std(axis=0) / np.asarray(log.joint_acceleration).std(axis=0) / RINGING["strong"]
    assert ((size > 0.5) & (size < 1.5)).all()
    hz, power = periodogram(torque, 1e3, axis=0)
    np.testing.assert_allclose(hz[power.argmax(axis=0)], drawn.mode[0], rtol=0.1)
    np.testing.assert_allclose(torque, drawn.mode[3] * (2.0 * np.pi * drawn.mode[0]) ** 2 * place, rtol=1e-12)


@pytest.mark.study
def test_the_defaults_are_judged(tmp_path: Path) -> None:
    make("panda", 0, tmp_path)
    status, out, err = call("default_accuracy", "judge", str(tmp_path), "--json", str(tmp_path / "out.json"))
    assert status == 0, err
    assert "panda" in out
    assert (tmp_path / "out.json").is_file()
