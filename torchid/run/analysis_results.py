"""What a finished analysis holds, and the folder it is written to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchid.analysis.base_check import StateCheck
from torchid.analysis.base_parameters import BaseParameters
from torchid.analysis.candidates import sensor_set
from torchid.analysis.planner import SensorPlan
from torchid.config import dump_config
from torchid.errors import during
from torchid.problem.plan import State
from torchid.report.accuracy import SetAccuracy, accuracy_figure
from torchid.report.analysis_document import base_document, base_text, checks_document, plan_document
from torchid.report.figures import save_figure
from torchid.report.tree_figure import tree_figure
from torchid.run.experiment import Scene
from torchid.run.folder import ANALYSIS, new_folder, write_json
from torchid.sensing import COMPONENTS


@dataclass(frozen=True)
class Scenario:
    """Answers for some contact states.

    `proposed`: what the sensors of the experiment file see, state by state, None if it names none. `base`: the base
    parameters that those sensors, or else the planned ones, could determine at best.
    """

    name: str
    states: tuple[State, ...]
    plan: SensorPlan
    proposed: tuple[StateCheck, ...] | None
    base: BaseParameters


@dataclass(frozen=True)
class Analysis:
    """All answers: by scenario, and the accuracy of sensor sets on logs."""

    scene: Scene
    scenarios: tuple[Scenario, ...]
    accuracies: dict[str, SetAccuracy]
    output: Path


def write_analysis(analysis: Analysis) -> None:
    """Write the folder."""
    scene, names = analysis.scene, analysis.scene.robot.body_names
    document: dict[str, Any] = {"scenarios": {}, "accuracy": None}
    texts, figures = [], {}
    for scenario in analysis.scenarios:
        plan, proposed = scenario.plan, scenario.proposed
        document["scenarios"][scenario.name] = plan_document(plan) | {
            "proposed": None if proposed is None else checks_document(proposed),
            "base_parameters": base_document(scenario.base, names),
        }
        which = "planned" if proposed is None else "proposed"
        texts.append(base_text(f"{scenario.name}, {which} sensors", scenario.base, names))
        figures[f"sensors-{scenario.name}"] = _picture(scene, scenario)
    if analysis.accuracies:
        document["accuracy"] = {name: found.as_dict() for name, found in analysis.accuracies.items()}
        figures["accuracy"] = accuracy_figure(analysis.accuracies)
    with during("writing", analysis.output), new_folder(analysis.output, scene.config.overwrite, ANALYSIS) as folder:
        (folder / "config.yaml").write_text(dump_config(scene.config))
        write_json(folder / "analysis.json", document)
        (folder / "base_parameters.txt").write_text("\n\n".join(texts))
        for name, figure in figures.items():
            save_figure(figure, folder / f"{name}.png")


def _picture(scene: Scene, scenario: Scenario) -> Figure:
    """The robot's tree with the planned sensors."""
    plan, robot = scenario.plan, scene.robot
    sensors = sensor_set(robot, scene.contacts, plan.chosen)
    used = [c for c, *active in zip(scene.contacts, *scenario.states, strict=True) if any(active)]
    wrenches = {
        contact.frame: [COMPONENTS[k] for k in np.flatnonzero(row)]
        for contact, row in zip(scene.contacts, sensors.wrench, strict=True)
    }
    measured = [name for name, taken in zip(robot.dof_names, sensors.torque, strict=True) if taken]
    constrained = [joint for branch in plan.branches if branch.constrained for joint in branch.joints]
    channels = sum(candidate.channels for candidate in plan.chosen)
    title = f"{scenario.name}: {channels} of {sum(c.channels for c in plan.question.candidates)} sensor channels"
    return tree_figure(title, robot, used, measured, wrenches, constrained)
