"""Under which imperfections the sensor sets are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torchid.config import SensorImperfectionsConfig, SimulationConfig


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
