"""The block `analysis` of an experiment file: candidates for sensors, scenarios, sets to compare."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid.config.sensors import STRICT, Choice, FileName
from torchid.settings import Positive, Seed

Name = Annotated[str, Field(min_length=1)]
Scenarios = dict[FileName, Annotated[list[list[str]], Field(min_length=1)]]


@dataclass(config=STRICT, frozen=True)
class CandidatesConfig:
    """Sensors that could be mounted: torques of `joint_torques` (None: all), and at the contacts devices or axes.

    `ft_sensors`: fixed joints that could carry a force/torque sensor, a device unless `contacts` are axes.
    `normal_forces`: contacts that could carry a scalar sensor, `fn`, beside a device or alone.
    """

    joint_torques: list[str] | None = None
    contacts: Literal["device", "axis", "none"] = "device"
    ft_sensors: list[str] = dataclasses.field(default_factory=list)
    normal_forces: list[str] = dataclasses.field(default_factory=list)


@dataclass(config=STRICT, frozen=True)
class AnalysisConfig:
    """Which sensors to plan for, and which sensor sets to compare.

    `scenarios`: contact states by scenario, each a list of the frames in contact; None: the states of the training
    logs, or, without logs, all contacts at once. `keep`: candidates that every plan has, `exclude`: that none has;
    `costs` per channel, by candidate or by kind (joint_torque, contact, normal_force, ft_sensor). `criterion`:
    per_sample, the base survives the projection of every sample (None, for a floating base); stack, many samples
    together determine all that full sensing would (None, for a fixed one). `compare`: sensor sets whose accuracy is
    predicted from the training logs and measured on the test logs; `prior_error`: standard deviation of the URDF's
    parameters, as a share of the size of each body.
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
