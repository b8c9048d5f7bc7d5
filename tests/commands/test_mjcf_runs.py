"""A run on an MJCF robot is that on its URDF, and `torchid export` writes for simulators what it has found."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from demo import DEMO, shortened_demo
from mujoco_oracle import INERTIA_ROUNDING
from run_folders import identified

import torchid
from torchid.cli import main
from torchid.commands import EXPORT_FORMATS
from torchid.commands.export import export
from torchid.config import load_config
from torchid.errors import ConfigError
from torchid.fitting.experiment import set_up
from torchid.problem.chunks import chunks_by_state
from torchid.problem.metrics import force_series
from torchid.reading.log_reader import LogReader
from torchid.report.mjcf_files import identified_mjcf, mjcf_of_urdf
from torchid.robot import load_robot

pytestmark = pytest.mark.filterwarnings("ignore:identified:torchid.errors.TorchidWarning")

LOG = DEMO / "sway_train.npz"


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo with short logs."""
    return shortened_demo(tmp_path_factory.mktemp("short") / "demo", 200)


@pytest.fixture(scope="module")
def runs(short: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Runs on the demo's quadruped as a URDF and as MJCF."""
    folder = tmp_path_factory.mktemp("runs")
    robot = load_robot(DEMO / "quadruped.urdf")
    (folder / "quadruped.xml").write_bytes(mjcf_of_urdf(robot, robot.nominal, {}))
    settings: dict[str, Any] = {"estimator": {"name": "consistent", "ridge": 1e-3}, "overwrite": True}
    out = {}
    for key, file in (("urdf", DEMO / "quadruped.urdf"), ("mjcf", folder / "quadruped.xml")):
        out[key] = folder / key
        own = settings | {"robot": {"urdf": None, key: file}, "output": out[key]}
        torchid.identify(short / "quadruped.yaml", **own)
    return out


def test_a_run_on_mjcf_finds_what_it_finds_on_the_urdf(runs: dict[str, Path]) -> None:
    one, other = (identified(runs[key]) for key in ("urdf", "mjcf"))
    np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-7 * np.abs(one).max())
    assert (runs["mjcf"] / "identified.xml").is_file()
    assert not (runs["mjcf"] / "identified.urdf").exists()


def test_the_written_mjcf_has_the_parameters_of_the_run(runs: dict[str, Path]) -> None:
    robot = load_robot(runs["mjcf"] / "identified.xml")
    size = np.abs(robot.nominal).max()
    atol = 1e-12 + INERTIA_ROUNDING * size
    np.testing.assert_allclose(robot.nominal, identified(runs["mjcf"]), rtol=1e-9, atol=atol)


@pytest.mark.parametrize("key", ["urdf", "mjcf"])
@pytest.mark.parametrize("form", EXPORT_FORMATS)
@pytest.mark.filterwarnings("ignore:URDF. the armature of")
def test_every_format_is_what_its_reader_reads(
    form: str, key: str, runs: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, target = load_robot(DEMO / "quadruped.urdf"), tmp_path / f"out.{dict(mjcf='xml').get(form, form)}"
    assert main(["export", str(runs[key]), "--format", form, "--output", str(target)]) == 0
    assert "written to" in capsys.readouterr().out
    text = target.read_text()
    if form in ("mjcf", "urdf"):
        read = load_robot(target)
        found = {name: read.nominal[read.body_names.index(name), 0] for name in robot.body_names}
        expected = dict(zip(robot.body_names, identified(runs[key])[:, 0], strict=True))
        assert found == pytest.approx(expected, rel=1e-9)
    elif form == "isaaclab":
        given: dict[str, Any] = {}
        code = text.replace("from isaaclab.actuators import ImplicitActuatorCfg", "ImplicitActuatorCfg = dict")
        exec(code, given)
        actuators = given["IDENTIFIED_ACTUATORS"]
        for name in robot.joint_names:
            assert [x for x in actuators["friction"] if re.fullmatch(x, name)] == [re.escape(name)]
        assert set(actuators["friction"]) == set(actuators["joint_names_expr"])
        assert "armature" not in actuators  # which was not fitted
    else:
        assert set(json.loads(text)["joints"]) == set(robot.joint_names)


def test_a_key_of_the_other_kind_is_refused(runs: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(
        torchid.TorchidError, match=r"robot.urdf: .* is not URDF; accepted: robot: \{mjcf: quadruped.xml\}"
    ):
        torchid.identify(
            DEMO / "quadruped.yaml", robot={"urdf": runs["mjcf"].parent / "quadruped.xml"}, output=tmp_path / "out"
        )


def test_the_log_is_replayed_on_the_mjcf_robot_as_on_the_urdf(runs: dict[str, Path], tmp_path: Path) -> None:
    from torchid.commands.replay import replay

    log = tmp_path / "log.npz"
    torchid.write_log(torchid.read_log(LOG).select(slice(0, 100)), log)
    drifts = [replay(runs[key], log, 0.1).drift for key in ("urdf", "mjcf")]
    for one, other in zip(*drifts, strict=True):
        np.testing.assert_allclose(one.joints, other.joints, atol=1e-4)


FOOT = '<geom type="capsule" fromto="0 0 0 0 0 -.3" size="0.05"/></body>'
PLANAR = f"""<mujoco><worldbody><body name="trunk"><joint name="x" type="slide" axis="1 0 0"/>
<joint name="z" type="slide" axis="0 0 1"/><geom type="sphere" size="0.1"/>
<body name="l_foot"><joint name="l_hip"/>{FOOT}<body name="r_foot"><joint name="r_hip"/>{FOOT}</body>
</worldbody></mujoco>"""


def test_init_writes_what_a_fit_takes_of_a_trunk_on_slides_with_feet(tmp_path: Path) -> None:
    """Its base is fixed: nothing of the base's motion is missing, and no foot is looked for that stands."""
    robot, log, file = (tmp_path / name for name in ("planar.xml", "log.npz", "new.yaml"))
    robot.write_text(PLANAR)
    motion = np.sin(np.outer(np.arange(200) / 100.0, [3.0, 5.0, 7.0, 11.0]))
    arrays = {"time": np.arange(200) / 100.0, "joint_position": motion, "joint_torque": motion}
    np.savez(log, joint_names=np.array(["x", "z", "l_hip", "r_hip"]), **arrays)
    assert main(["init", str(robot), str(log), "--output", str(file)]) == 0
    setup = set_up(load_config(file))
    assert setup.robot.fixed_base
    assert [contact.frame for contact in setup.contacts] == ["l_foot", "r_foot"]
    assert yaml.safe_load(file.read_text())["logs"]["columns"]["contact_active"] == {"always": ["l_foot", "r_foot"]}


def models(runs: dict[str, Path], folder: Path, of_joints: str) -> tuple[Path, Path]:
    """The robot's model, and one whose joints have attributes more."""
    bare, other = runs["mjcf"].parent / "quadruped.xml", folder / "rotors.xml"
    other.write_text(bare.read_text().replace("<joint ", f"<joint {of_joints} "))
    return bare, other


def test_a_known_armature_is_taken_off_the_torques_and_a_fitted_one_is_all_of_it(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    bare, with_rotors = models(runs, tmp_path, 'armature="0.05" stiffness="2" springref="0.1"')
    rows = {}
    for name, file, fitted in (("all", bare, True), ("none", bare, False), ("known", with_rotors, False)):
        actuators = {"armature": fitted, "stiffness": fitted, "torque_offset": fitted}
        sections: dict[str, Any] = {"robot": {"urdf": None, "mjcf": file}, "actuators": actuators}
        experiment = set_up(load_config(DEMO / "quadruped.yaml", (), sections | {"output": None}))
        (samples,) = LogReader(experiment, None).read([LOG], None, lambda _: None)
        builder, (state, index) = experiment.builder(experiment.sensors), next(iter(chunks_by_state(samples)))
        rows[name] = builder.rows_by_sample(samples[index], state)[0].numpy()
        series = force_series(
            builder, samples, np.append(experiment.robot.nominal, np.zeros(len(builder.extras)))[None]
        )
        rows[f"predicted {name}"] = series[1][0]
    size = rows["none"].shape[2] - 1
    armature, offset, stiffness = (rows["all"][..., size:-1][..., k : k + 12].sum(-1) for k in (0, 12, 24))
    expected = rows["none"][..., -1] - (0.05 * armature + 2.0 * stiffness - 0.2 * offset)
    np.testing.assert_allclose(rows["known"][..., -1], expected, atol=1e-10 * np.abs(expected).max())
    torque = 0.05 * samples.joint_acceleration + 2.0 * (samples.joint_position - 0.1)
    difference = rows["predicted known"][:, 6:] - rows["predicted none"][:, 6:]
    np.testing.assert_allclose(difference, torque.numpy(), atol=1e-10)


@pytest.mark.filterwarnings("ignore::torchid.errors.ConfoundedWarning")
def test_a_fitted_armature_does_not_depend_on_that_of_the_file_and_is_written(
    runs: dict[str, Path], tmp_path: Path
) -> None:
    settings: dict[str, Any] = {
        "logs": {"train": [f"{LOG}[:2]"], "test": []},
        "output": None,
        "actuators": {"armature": True},
        "estimator": {"name": "least_squares", "ridge": 1e-3},
    }
    fits = [
        torchid.identify(DEMO / "quadruped.yaml", robot={"urdf": None, "mjcf": file}, **settings)
        for file in models(runs, tmp_path, 'armature="0.05"')
    ]
    armatures = [fit.fitted_joints.armature for fit in fits]
    assert armatures[1] == pytest.approx(armatures[0], abs=1e-10)
    robot = fits[1].experiment.robot
    text = identified_mjcf(robot, robot.nominal, armatures[1]).decode()
    written = dict(re.findall(r'<joint armature="([^"]*)" name="([^"]*)"', text))
    assert {name: float(value) for value, name in written.items()} == armatures[1]


def test_a_log_is_checked_against_one_robot_alone(runs: dict[str, Path]) -> None:
    file = runs["mjcf"].parent / "quadruped.xml"
    with pytest.raises(ConfigError, match="urdf or mjcf"):
        torchid.check(LOG, robot={"mjcf": file, "urdf": DEMO / "quadruped.urdf"})


def test_no_file_is_replaced_unless_told_so(runs: dict[str, Path], tmp_path: Path) -> None:
    target = tmp_path / "out.json"
    target.write_text("mine")
    with pytest.raises(torchid.TorchidError, match="exists; accepted: a new file, or --overwrite"):
        export(runs["urdf"], "json", target)
    export(runs["urdf"], "json", target, overwrite=True)
    assert json.loads(target.read_text())["joints"]
