"""What commands that simulate a robot print: `simulate` of how it stood, `replay` of how far it drifts from a log.

Apart from `terminal/identification.py`, whose commands need no MuJoCo.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

from rich.table import Table

from torchid.commands.answer import times_smaller
from torchid.commands.replay import Replay
from torchid.commands.simulate import nominal_name, simulated_balls
from torchid.config import SimulationConfig
from torchid.errors import format_count
from torchid.report.tables import (
    LINES,
    column_lines,
    labelled,
    make_table,
    rolling_lines,
    rows_within,
    wrap_words,
    written_line,
)
from torchid.simulation import Stability

_TEXT_LINES = 2


def simulation_lines(config: SimulationConfig, stabilities: Mapping[str, Stability], width: int) -> list[str]:
    """The answer, in lines of at most so many columns, but for names that are longer.

    Args:
        config: what was simulated.
        stabilities: how the robot stood, by motion; at least one.
        width: of the terminal.
    """
    lines = [*wrap_words(_headline(config, stabilities), width), ""]
    end = labelled("rolling", balls, width, _TEXT_LINES) if (balls := simulated_balls(config)) else []
    nominal = nominal_name(config)
    kind = "URDF" if config.robot.mjcf is None else "MJCF"
    text = f"use logs/ and {nominal}; true values: exact/ and the simulated {kind}"
    end += labelled("to identify", text, width, _TEXT_LINES)
    end.append(written_line(config.output))
    room = LINES - len(lines) - len(end)
    return [*lines, *_motion_lines(config, stabilities, room, width), *end]


def all_motion_lines(config: SimulationConfig, stabilities: Mapping[str, Stability], width: int) -> list[str | Table]:
    """How the robot stood in every motion, with all columns whatever the width."""
    columns = _columns(stabilities.values())
    rows = zip(stabilities, *(texts for _, texts in columns), strict=True)
    table = make_table("Standing", ("motion", *(heading for heading, _ in columns)), rows)
    return [*rolling_lines(simulated_balls(config), width), table, written_line(config.output)]


def _headline(config: SimulationConfig, stabilities: Mapping[str, Stability]) -> str:
    seconds = sum(motion.duration_s for motion in config.motions)
    motions = format_count(len(stabilities), "motion")
    slip = 1e3 * max(x.slip for x in stabilities.values())
    margin = 1e3 * min(x.zmp_margin for x in stabilities.values())
    bounds = f"feet slip at most {slip:.1f} mm, the zero-moment point stays {margin:.0f} mm inside the support"
    effort = max(x.effort for x in stabilities.values())
    limits = f", torques reach {100 * effort:.0f} % of their limits" if effort else ""
    return f"The robot stands during {motions} ({seconds:.4g} s): {bounds}{limits}."


def _motion_lines(config: SimulationConfig, stabilities: Mapping[str, Stability], room: int, width: int) -> list[str]:
    """A table of the motions, the nearest to a bound first, in at most so many lines."""

    def use(stability: Stability) -> float:
        """The largest share of a bound that is used up."""
        bounds = config.bounds
        margin = stability.zmp_margin
        near = bounds.zmp_m / margin if margin > 0.0 else 1.0
        return max(stability.slip / bounds.slip_m, stability.height_change / bounds.height_m, stability.effort, near)

    order = sorted(stabilities, key=lambda name: use(stabilities[name]), reverse=True)
    columns = _columns([stabilities[name] for name in order])
    return rows_within(("motion", order), columns, width, room, "more motions: --verbose")


def _columns(stabilities: Collection[Stability]) -> list[tuple[str, list[str]]]:
    """Headings and cells, the most important first."""
    return [
        ("slip [mm]", [f"{1e3 * x.slip:.1f}" for x in stabilities]),
        ("ZMP inside by [mm]", [f"{1e3 * x.zmp_margin:.0f}" for x in stabilities]),
        ("effort [%]", [f"{100 * x.effort:.0f}" if x.effort else "" for x in stabilities]),
        ("base height [m]", ["{:.3f} to {:.3f}".format(*x.base_height) for x in stabilities]),
        ("feet up [%]", [", ".join(f"{100 * share:.0f}" for share in x.unloaded) for x in stabilities]),
    ]


_MOST = 6  # joints in the answer
_SHARES = (0.2, 0.4, 1.0)  # of a window


def replay_lines(replayed: Replay, width: int, verbose: bool = False) -> list[str]:
    """A sentence, the drift at a few times, and the joints that drift most; lines of at most so many columns.

    Args:
        replayed: what was found.
        width: of the terminal.
        verbose: with all joints.
    """
    lines = wrap_words(_drift(replayed), width, "  ")
    names = list[str]()
    columns = [(f"{share * replayed.window:g} s", list[str]()) for share in _SHARES]
    for name in replayed.at(replayed.window):
        drawn = [f"{len(replayed.sampled)} samples"] if replayed.sampled else []
        names += [f"{name}, {who}" for who in (replayed.of, "identified", *drawn)]
        for (_, column), share in zip(columns, _SHARES, strict=True):
            column += [f"{x:.4g}" for x in replayed.at(share * replayed.window)[name]]
            if drawn:
                column.append(" to ".join(f"{x:.3g}" for x in replayed.ranges_at(share * replayed.window)[name]))
    lines += column_lines(("median drift after", names), columns, width)
    joints = sorted(replayed.by_joint().items(), key=lambda x: -x[1].identified)
    cells = [
        (replayed.of, [f"{x.nominal:.4g}" for _, x in joints]),
        ("identified", [f"{x.identified:.4g}" for _, x in joints]),
    ]
    headings = (f"joint, after {replayed.window:g} s", [name for name, _ in joints])
    room = len(joints) + 1 if verbose else _MOST + 2
    lines += ["", *rows_within(headings, cells, width, room, "joints with less drift: --verbose")]
    if replayed.output is not None:
        lines.append(written_line(replayed.output))
    return lines


def _drift(replayed: Replay) -> str:
    """How much less the identified robot drifts."""
    drifts = replayed.at(replayed.window)
    what = Counter(name.partition(" [")[0] for name in drifts)  # with units where joints have two
    named = {name: bare if what[bare := name.partition(" [")[0]] == 1 else name for name in drifts}
    ratios = {named[name]: after / before for name, (before, after) in drifts.items() if before}
    compared = ", ".join(f"{name} {times_smaller(ratio, ratio)}" for name, ratio in ratios.items())
    worse = f"WORSE THAN {replayed.of}: " * any(after > before for before, after in drifts.values())
    head = f"{worse}Drift after {replayed.window:g} s, driven by {replayed.driven}, compared with the {replayed.of}"
    return f"{head}: {compared} ({format_count(replayed.windows, 'window')})."
