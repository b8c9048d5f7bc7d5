"""The cutoff of the filter, where the settings leave it to the training logs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from rich.progress import Progress

from torchid import ranks
from torchid.commands.check import recorded_stretches
from torchid.fitting.experiment import S, Scene
from torchid.logs.cutoff import CutoffChoice, choose_cutoff


def with_cutoff(scene: S, bars: Progress) -> tuple[S, CutoffChoice | None]:
    """The scene with a cutoff that is a number or none, and how it was chosen, if it was.

    Args:
        scene: with logs to fit on.
        bars: shows that this goes on.

    Raises:
        InputError: logs that cannot be read.
    """
    if scene.config.preprocessing.cutoff_hz != "auto" or scene.config.logs is None:
        return scene, None
    bar = bars.add_task("choosing the cutoff", total=None)
    choice = ranks.from_first(partial(_chosen, scene), "cutoff")
    bars.update(bar, total=1, completed=1)
    settings = replace(scene.config.preprocessing, cutoff_hz=choice.cutoff_hz)
    return replace(scene, config=replace(scene.config, preprocessing=settings)), choice


def _chosen(scene: Scene) -> CutoffChoice:
    """By the middle of each training log."""
    settings, files = scene.config.preprocessing, scene.config.logs
    if files is None:
        return CutoffChoice(None, by_noise=False)
    logs = [next(recorded_stretches(path, files, settings))[0] for path in files.train]
    stated, from_feet = scene.config.sensors.noise.motion, settings.base_motion is not None
    return choose_cutoff(logs, stated, settings.sample_rate_hz, base_is_derived=from_feet)
