"""Draw the figures of docs/concepts.md and of the README, all of the demo's quadruped.

    python scripts/concept_figures.py                   # into docs
    python scripts/concept_figures.py --folder figures

The demo is identified as its experiment file says; the friction of its simulation is known (scripts/make_demo.py).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import torchid
from torchid.boundary import run_guarded
from torchid.commands.run_folder import Identification
from torchid.parameters import GRAVITY, PARAMETERS, PER_BODY, Array
from torchid.problem.metrics import force_series, null_space_part
from torchid.reading.log_reader import LogReader
from torchid.report.figure_style import (
    IDENTIFIED_COLOR,
    MEASURED_COLOR,
    NOISE_COLOR,
    NOMINAL_COLOR,
    STYLE,
    save_figures,
)
from torchid.report.figures import INTERVAL, identifiability_figure
from torchid.report.forces import ForceSeries, force_figure

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "torchid" / "demo" / "quadruped.yaml"
TRUE_FRICTION = {"fc": 0.3, "fv": 0.05}  # of scripts/make_demo.py [N m, N m s/rad]


def main() -> int:
    """Identify the demo and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=ROOT / "docs")
    options = parser.parse_args()
    return run_guarded("concept_figures", lambda: draw(options.folder))


def draw(folder: Path) -> None:
    """Write the figures."""
    run = torchid.identify(DEMO, output=None)
    robot = run.experiment.robot
    assert run.forces is not None
    with matplotlib.rc_context(STYLE):
        figures = {
            "concept_projection": projection_figure(*unmeasured_forces(run)),
            "concept_verdicts": identifiability_figure(robot.body_names, run.estimate),
            "concept_intervals": interval_figure(run),
            "demo_forces": readme_figure(run, run.forces),
        }
    folder.mkdir(parents=True, exist_ok=True)
    save_figures(figures, folder, "png")


def readme_figure(run: Identification, forces: ForceSeries) -> Figure:
    """Forces of the base and of a joint, and why the error of the base force leaves the band of the noise."""
    robot = run.experiment.robot
    rows = (2, robot.base_rows + robot.joint_names.index("front_left_hip"))
    forces = replace(forces, states=(), state=None)
    figure = force_figure(forces, robot.dof_names, robot.base_rows, robot.sliding, robot.format, rows)
    mean = float(np.nanmean(forces.identified[:, 2] - forces.measured[:, 2]))
    error = GRAVITY * run.mass.standard_error
    text = f"mean {mean:.2g} N; total mass known to ± {run.mass.standard_error:.2g} kg, so to ± {error:.2g} N"
    axis = figure.axes[1]
    axis.set_title(f"{axis.get_title(loc='left')}\n{text}", loc="left", fontsize=9)
    return figure


def unmeasured_forces(run: Identification) -> tuple[Array, Array, Array]:
    """Time (N,) [s] of an unseen log, and K phi - S^T tau of two rows, (2, N), before and after projection."""
    experiment = run.experiment
    builder, config = experiment.builder(experiment.sensors), experiment.config
    (log,) = LogReader(experiment).read(config.logs.test, experiment.sensors)
    predicted = force_series(builder, log, run.phi.reshape(1, -1))[1]
    assert log.torque is not None
    torque = np.pad(log.torque.cpu().numpy(), ((0, 0), (builder.tree.base_rows, 0)))
    left = predicted - torque
    shown = [2, builder.tree.base_rows + experiment.robot.joint_names.index("front_left_knee")]
    return log.time.cpu().numpy(), left[0][:, shown].T, null_space_part(builder, log, left)[0][:, shown].T


def projection_figure(time: Array, before: Array, after: Array) -> Figure:
    """The residual of two rows of the equations, before and after the projection."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    rows = ("base force z [N]", "front_left_knee [N m]")
    titles = ("before: foot forces are missing", "after projection: noise")
    for column, (title, values) in enumerate(zip(titles, (before, after), strict=True)):
        for axis, name, series in zip(axes[:, column], rows, values, strict=True):
            axis.plot(time, series, color=(NOMINAL_COLOR, IDENTIFIED_COLOR)[column], linewidth=1.0)
            axis.set_title(f"{title}, rms {np.sqrt(np.mean(series**2)):.3g}", loc="left")
            axis.set_ylabel(name)
            axis.set_xlim(0.0, time[-1])
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    return figure


def interval_figure(run: Identification) -> Figure:
    """Friction of every joint with its 95 % interval, beside the truth."""
    robot, units = run.experiment.robot, {"fc": "Coulomb friction [N m]", "fv": "viscous friction [N m s/rad]"}
    errors = run.estimate.standard_error.reshape(-1, PER_BODY)
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    names = [body.joint.name for body in robot.bodies if body.joint is not None]
    for axis, (name, true) in zip(figure.subplots(1, 2, sharey=True), TRUE_FRICTION.items(), strict=True):
        k, place = PARAMETERS.index(name), range(len(names))
        reach = INTERVAL * errors[1:, k]
        axis.errorbar(
            run.phi[1:, k], place, xerr=reach, fmt="o", color=IDENTIFIED_COLOR, capsize=2, label="identified, 95 %"
        )
        axis.axvline(true, color=MEASURED_COLOR, linewidth=1.0, linestyle="--", label="truth of the simulation")
        axis.axvline(0.0, color=NOISE_COLOR, linewidth=0.8)
        axis.set_yticks(place, names)
        axis.set_xlabel(units[name])
    axis.invert_yaxis()
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2)
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
