"""What `torchid analyze` is asked, beside the robot, its contacts and logs."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid.config.sensors import Choice
from torchid.config.types import STRICT, FileName, Positive, Seed

Name = Annotated[str, Field(min_length=1)]
Scenarios = dict[FileName, Annotated[list[list[str]], Field(min_length=1)]]


@dataclass(config=STRICT, frozen=True)
class CandidatesConfig:
    """Sensors that could be mounted: torques of these joints (None: all), and at the contacts whole devices or axes.

    `ft_sensors`: fixed joints that could carry a force/torque sensor, whole devices unless `contacts` are axes.
    """

    joint_torques: list[str] | None = None
    contacts: Literal["device", "axis", "none"] = "device"
    ft_sensors: list[str] = dataclasses.field(default_factory=list)


@dataclass(config=STRICT, frozen=True)
class AnalysisConfig:
    """What is asked of the sensors.

    `scenarios`: contact states by scenario, each the frames in contact; None: the states of the training logs, or,
    without logs, all contacts at once. `keep`: candidates that are mounted anyway, `exclude`: that cannot be; `costs`
    by candidate or by kind (joint_torque, contact, ft_sensor), a channel. `criterion`: the base survives the projection
    of every sample (None, for a floating base), or many samples together determine all that full sensing would (None,
    for a bolted one). `compare`: sensor sets whose accuracy is predicted from the training logs and measured on the
    test logs; `prior_error`: how far off the URDF may be, against the size of each body.
    """

    scenarios: Annotated[Scenarios, Field(min_length=1)] | None = None
    candidates: CandidatesConfig = dataclasses.field(default_factory=CandidatesConfig)
    keep: list[str] = dataclasses.field(default_factory=list)
    exclude: list[str] = dataclasses.field(default_factory=list)
    costs: dict[str, Positive] = dataclasses.field(default_factory=dict)
    criterion: Literal["per_sample", "stack"] | None = None
    compare: dict[Name, Choice] = dataclasses.field(default_factory=dict)
    prior_error: Annotated[Positive, Field(le=100.0)] = 0.2
    seed: Seed = 0
