"""The width over which Coulomb friction reverses, where the settings leave it to the training logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from rich.progress import Progress

from torchid import ranks
from torchid.commands.reading import LogReader
from torchid.estimators import Conditions
from torchid.fitting.experiment import Experiment, S, Scene
from torchid.fitting.fit import LogFitter
from torchid.fitting.noise import recorded_sensors
from torchid.fitting.sign_width import SignWidthChoice, choose_sign_width
from torchid.problem import Samples


def with_sign_width(scene: S, bars: Progress) -> tuple[S, SignWidthChoice | None]:
    """The scene with a width that is a number or none, and how it was chosen, if it was.

    Logs are read anew for every width, since the filter comes after the friction.

    Args:
        scene: with logs to fit on; without sensors, all that were recorded count.
        bars: shows that this goes on.

    Raises:
        InputError: logs that cannot be read, or have no joint torques.
    """
    if scene.config.actuators.sign_width != "auto" or scene.config.logs is None:
        return scene, None
    bar = bars.add_task("choosing the sign width", total=None)
    choice = ranks.from_first(partial(choose_sign_width, partial(_logs_and_fitter, scene)), "sign width")
    bars.update(bar, total=1, completed=1)
    return _with_width(scene, choice.width), choice


def _with_width(scene: S, width: float | None) -> S:
    config = scene.config
    return replace(scene, config=replace(config, actuators=replace(config.actuators, sign_width=width)))


def _logs_and_fitter(scene: Scene, width: float | None) -> tuple[Sequence[Samples], LogFitter]:
    """The training logs, and a fitter of their rows, with a width."""
    scene = _with_width(scene, width)
    sensors = scene.sensors if isinstance(scene, Experiment) else None
    logs = LogReader(scene).read(scene.config.logs.train if scene.config.logs else [], sensors)
    if sensors is None:
        sensors = recorded_sensors(scene.robot, scene.contacts, logs, scene.noise)
    return logs, scene.fitter(scene.builder(sensors), Conditions(names=scene.robot.body_names))
