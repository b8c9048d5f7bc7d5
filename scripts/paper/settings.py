"""The settings of a study: motions, sensor imperfections, and how studies combine them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from torchid.config import SensorImperfectionsConfig, SimulationConfig
from torchid.errors import ConfigError


@dataclass(frozen=True)
class Condition:
    """Imperfections of the sensors, and whether the plant's joints have friction; `random`: whether draws differ."""

    name: str
    sensors: SensorImperfectionsConfig
    friction: bool = False
    random: bool = False


def conditions(config: SimulationConfig) -> tuple[Condition, ...]:
    """Exact sensors, each imperfection on its own, and all together, at the levels of a simulation file."""
    levels = config.sensors

    def sensors(*enabled: str) -> SensorImperfectionsConfig:
        parts = {name: getattr(levels, name) for name in ("noise", "bias", "delay")}
        switched = {name: replace(part, enabled=name in enabled) for name, part in parts.items()}
        return replace(levels, **switched)

    return (
        Condition("exact sensors", sensors()),
        Condition("white noise", sensors("noise"), random=True),
        Condition("bias and gain", sensors("bias"), random=True),
        Condition("delay", sensors("delay")),
        Condition("joint friction", sensors(), friction=True),
        Condition("all", sensors("noise", "bias", "delay"), friction=True, random=True),
    )


SHOWN = ("white noise", "all runs")  # condition and training set of the figures
SQUATS, UNSEEN = "squat_", "unseen_"  # how the names of the squats, and of the motion that no fit uses, begin
TRAINING = {"all runs": ("squats", "others"), "squats alone": ("squats",)}

_QUICK_S = {"squat_1.0hz": 2.9, "squat_2.5hz": 2.9, "sway_0.5hz": 6.4, "unseen_1.5hz": 2.9}


@dataclass(frozen=True)
class Study:
    """The settings of a study.

    Attributes:
        simulation: the motions; the study switches the imperfections, at the levels given there.
        experiments: experiment files by name of the sensor set; robot and logs in them are the study's.
        noise_draws: draws of white noise, and of biases and gains.
        nominal_draws: draws of the nominal parameters.
    """

    simulation: SimulationConfig
    experiments: Mapping[str, Path]
    noise_draws: int = 3
    nominal_draws: int = 5

    def __post_init__(self) -> None:
        """Check that there are motions for training, and one for testing."""
        names = [motion.name for motion in self.simulation.motions]
        kinds = [name.startswith(SQUATS) for name in names], [name.startswith(UNSEEN) for name in names]
        if not any(kinds[0]) or sum(kinds[1]) != 1:
            accepted = f"some whose names begin with {SQUATS}, and one with {UNSEEN}"
            raise ConfigError.at_field("motions", ", ".join(names), accepted)

    def quick(self) -> Study:
        """The same in a minute: fewer and shorter motions, fewer draws."""
        motions = [
            replace(motion, duration_s=_QUICK_S[motion.name])
            for motion in self.simulation.motions
            if motion.name in _QUICK_S
        ]
        return replace(self, simulation=replace(self.simulation, motions=motions), noise_draws=1, nominal_draws=2)
