"""The robot of an experiment as it was in one log, with what it carried there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torchid.fitting.experiment import S, Scene
from torchid.parameters import Array
from torchid.robot import payload_parameters, with_payload


def payload_of(scene: Scene, path: str | Path) -> Array | None:
    """What the robot carried in a log, (12 L,), as `Samples.payload` has it; None for nothing."""
    payloads = () if scene.config.logs is None else scene.config.logs.payloads_of(path)
    return payload_parameters(scene.robot, payloads) if payloads else None


def scene_of_log(scene: S, path: str | Path) -> S:
    """The scene with the nominal robot as it was in a log, for whatever compares recordings with it."""
    return replace(scene, robot=with_payload(scene.robot, payload_of(scene, path)))
