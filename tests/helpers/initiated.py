"""What `torchid init` makes of a recording of the demo's quadruped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dialects import in_order, with_velocity
from repository import DEMO

from torchid.commands.init import InitReport, init
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.logs import Log, read_log

URDF = DEMO / "quadruped.urdf"


def recorded() -> Log:
    return with_velocity(read_log(DEMO / "sway_train.npz").select(slice(0, 300)))


def initiated(path: Path, urdf: Path = URDF) -> tuple[Log, InitReport, str]:
    """The log that an experiment file of `init` reads, what was said, and the file."""
    said = init(urdf, path, path.with_suffix(".yaml"))
    config = load_config(path.with_suffix(".yaml"))
    set_up(config)
    return read_log(path, columns=config.logs.columns), said, path.with_suffix(".yaml").read_text()


def columns_of(log: Log, names: tuple[str, str, str], first: int = 0) -> dict[str, Any]:
    """Columns by number of position, velocity and torque, in an order of motors."""
    given = (log.joint_position, log.joint_velocity, log.joint_torque)
    return {
        name.format(k + first): in_order(log, x)[:, k] for name, x in zip(names, given, strict=True) for k in range(12)
    }
