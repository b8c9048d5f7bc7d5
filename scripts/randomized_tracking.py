"""What samples are for, without a policy: one PD controller on the true robot, the URDF's, the identified and samples.

    python scripts/randomized_tracking.py --figure docs/randomized_tracking.png     # half a minute
    python scripts/randomized_tracking.py --seed 3 --samples 50

The demo's quadruped, bolted to a stand, is unlike its URDF: masses, centres of mass and inertias up to 30 % off, joint
friction and armatures that the URDF does not know. A log of 20 s, slow sines of all joints, torques with noise of
0.1 N m, is identified. Then a PD controller swings the legs faster, in MuJoCo, on the true robot, on the URDF's, on the
identified one, on samples of the posterior, and on robots randomized by hand: the URDF with errors of up to 30 %,
friction and armatures from 0 to what the true robot may have. Tracking errors are rms over joints and time; the other
figure is how far a robot's motion is from the true robot's. Needs MuJoCo.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import mujoco
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

import torchid
from torchid.boundary import run_guarded
from torchid.fitting.posterior import ParameterSamples
from torchid.logs import Log, write_log
from torchid.parameters import FRICTION, Array, perturb_parameters
from torchid.report.figure_style import CATEGORY_COLORS, IDENTIFIED_COLOR, MEASURED_COLOR, NOISE_COLOR, NOMINAL_COLOR
from torchid.report.mjcf_files import mjcf_of_urdf
from torchid.robot import Robot

_URDF = Path(torchid.__file__).parent / "demo" / "quadruped.urdf"
_POSTURE = np.tile([0.0, 0.6, -1.2], 4)
_STIFFNESS, _DAMPING = 40.0, 1.0  # N m/rad, N m s/rad
_SECONDS, _RATE, _STEP = 20.0, 100.0, 1e-3
_SWING = 4.0  # s
_NOISE = 0.1  # N m


@dataclass(frozen=True)
class Model:
    """Parameters (L, 12) and armatures by joint [kg m^2]."""

    phi: Array
    armature: Mapping[str, float]


def sines(time: Array, amplitude: float, low: float, high: float, rng: np.random.Generator) -> tuple[Array, ...]:
    """Positions, velocities and accelerations, (N, 12), about the posture: three sines for each joint."""
    frequency = 2.0 * np.pi * rng.uniform(low, high, (3, 12))
    phase, share = rng.uniform(0.0, 2.0 * np.pi, (3, 12)), amplitude / 3.0
    angle = frequency * time[:, None, None] + phase
    q = share * np.sin(angle).sum(axis=1) + _POSTURE
    return q, share * (frequency * np.cos(angle)).sum(axis=1), -share * (frequency**2 * np.sin(angle)).sum(axis=1)


def true_model(robot: Robot, rng: np.random.Generator) -> Model:
    """Unlike the URDF."""
    phi = perturb_parameters(robot.nominal, 0.3, rng)
    phi[1:, FRICTION] = rng.uniform([0.2, 0.05], [0.5, 0.15], (len(phi) - 1, 2))
    return Model(phi, dict(zip(robot.joint_names, rng.uniform(0.005, 0.02, robot.n).tolist(), strict=True)))


def recorded(robot: Robot, true: Model, rng: np.random.Generator) -> Log:
    """The log of the true robot in slow motion."""
    time = np.arange(0.0, _SECONDS, 1.0 / _RATE)
    q, v, a = sines(time, 0.5, 0.1, 0.8, rng)
    K = torchid.Regressor(robot)(*(torch.from_numpy(x) for x in (q, v, a))).numpy()
    torque = K @ true.phi.flatten() + a * np.array(list(true.armature.values()))
    torque += _NOISE * rng.normal(size=torque.shape)
    return Log("stand", time, robot.joint_names, q, v, a, torque)


def identified(log: Log, folder: Path) -> torchid.Identification:
    """What `torchid identify` makes of the log, alone with the URDF."""
    write_log(log, folder / "stand.npz")
    return torchid.identify(
        robot={"urdf": str(_URDF), "fixed_base": True},
        logs=[str(folder / "stand.npz")],
        sensors={"set": "joints", "noise": {"joint_torque": _NOISE}},
        actuators={"armature": True},
        estimator={"name": "consistent", "ridge": "auto"},
    )


def swing(robot: Robot, model: Model, seed: int) -> tuple[Array, Array]:
    """Positions that the controller wants and that the robot has, (N, 12), in MuJoCo."""
    compiled = mujoco.MjModel.from_xml_string(mjcf_of_urdf(robot, model.phi, model.armature, meshes=False).decode())
    compiled.opt.timestep, compiled.opt.integrator = _STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(compiled)
    at = [compiled.joint(name).qposadr[0] for name in robot.joint_names]
    wanted, _, _ = sines(np.arange(0.0, _SWING, _STEP), 0.6, 0.5, 2.0, np.random.default_rng([seed, 2]))
    data.qpos[at] = wanted[0]
    out = np.empty_like(wanted)
    for number, target in enumerate(wanted):
        out[number] = data.qpos[at]
        data.qfrc_applied[at] = _STIFFNESS * (target - data.qpos[at]) - _DAMPING * data.qvel[at]
        mujoco.mj_step(compiled, data)
    return wanted, out


def models_of(samples: ParameterSamples) -> list[Model]:
    """A model for each sample."""
    armature = samples.of_joints("armature")
    return [
        Model(phi, {name: float(x[number]) for name, x in armature.items()})
        for number, phi in enumerate(samples.phi.numpy())
    ]


def by_hand(robot: Robot, count: int, rng: np.random.Generator) -> list[Model]:
    """What an expert would randomize who knows how far the true robot may be off: ranges that hold it."""
    out = []
    for _ in range(count):
        true = true_model(robot, rng)
        scale = rng.uniform(0.0, 1.0, (len(true.phi), 2))
        true.phi[:, FRICTION] = scale * (0.5, 0.15) * (np.arange(len(scale)) > 0)[:, None]
        out.append(Model(true.phi, dict(zip(robot.joint_names, rng.uniform(0.0, 0.02, robot.n).tolist(), strict=True))))
    return out


def rms(x: Array) -> float:
    """Over joints and time."""
    return float(np.sqrt(np.mean(np.square(x))))


def compare(options: argparse.Namespace) -> dict[str, tuple[list[float], list[float]]]:
    """Tracking errors, and distances from the true robot's motion [rad], by kind of model."""
    robot, rng = torchid.load_robot(_URDF, fixed_base=True), np.random.default_rng(options.seed)
    true = true_model(robot, rng)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", torchid.TorchidWarning)
        run = identified(recorded(robot, true, rng), Path(folder))
    samples = torchid.PosteriorSampler(run.posterior).sample(
        options.samples, torch.Generator().manual_seed(options.seed)
    )
    models = {
        "true robot": [true],
        "URDF": [Model(robot.nominal, {})],
        "by hand": by_hand(robot, options.samples, rng),
        "identified": [Model(run.phi, run.fitted_joints.armature)],
        "samples": models_of(samples),
    }
    _, truth = swing(robot, true, options.seed)
    out = {}
    for name, every in models.items():
        motions = [swing(robot, model, options.seed) for model in every]
        out[name] = [rms(q - wanted) for wanted, q in motions], [rms(q - truth) for _, q in motions]
    return out


def draw(found: dict[str, tuple[list[float], list[float]]], path: Path) -> None:
    """The figure: a point for each robot."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    colours = dict(
        zip(found, (MEASURED_COLOR, NOMINAL_COLOR, NOISE_COLOR, IDENTIFIED_COLOR, CATEGORY_COLORS[0]), strict=True)
    )
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 2.8), sharey=True, layout="constrained")
    titles = "tracking error [mrad rms]", "distance from the true robot's motion [mrad rms]"
    rng = np.random.default_rng(0)
    for axis, title, part in zip(axes, titles, range(2), strict=True):
        for height, (name, values) in enumerate(found.items()):
            x = 1e3 * np.array(values[part])
            spread = rng.uniform(-0.25, 0.25, len(x)) if len(x) > 1 else np.zeros(1)
            axis.plot(x, -height + spread, "o" if len(x) > 1 else "D", color=colours[name], ms=4 if len(x) > 1 else 7)
        axis.set_xlabel(title)
        axis.grid(axis="x", alpha=0.3)
    axes[0].axvline(1e3 * found["true robot"][0][0], color=MEASURED_COLOR, lw=0.8)
    axes[0].set_yticks([-height for height in range(len(found))], list(found))
    figure.savefig(path, dpi=100)


def run(options: argparse.Namespace) -> None:
    """Compare, print, draw."""
    found = compare(options)
    table = Table(title="rms over joints and time in mrad: median (least to largest)")
    for name in ("robot", "tracking error", "distance from the true motion"):
        table.add_column(name)
    for name, parts in found.items():
        texts = []
        for values in parts:
            x = 1e3 * np.array(values)
            texts.append(f"{np.median(x):.1f}" + (f" ({x.min():.1f} to {x.max():.1f})" if len(x) > 1 else ""))
        table.add_row(name, *texts)
    Console(width=100).print(table)
    if options.figure is not None:
        draw(found, options.figure)


def main() -> int:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    return run_guarded("randomized_tracking", lambda: run(options))


if __name__ == "__main__":
    raise SystemExit(main())
