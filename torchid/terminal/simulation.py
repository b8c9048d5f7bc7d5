"""What `torchid simulate` prints: how the robot stood in all motions and in the worst, or in each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

from torchid.commands.simulate import nominal_name, simulated_balls
from torchid.config import SimulationConfig
from torchid.errors import format_count
from torchid.report.tables import print_tables, stability_table, terminal_width
from torchid.simulation import Stability
from torchid.terminal.lines import LABEL, LINES, column_lines, labelled, print_rolling, wrap_words

_TEXT_LINES = 2


def print_simulation(config: SimulationConfig, stabilities: Mapping[str, Stability]) -> None:
    """Print the answer for the terminal's width."""
    print("\n".join(simulation_lines(config, stabilities, terminal_width())))


def simulation_lines(config: SimulationConfig, stabilities: Mapping[str, Stability], width: int) -> list[str]:
    """The answer, in lines of at most so many columns, but for names that are longer.

    Args:
        config: what was simulated.
        stabilities: how the robot stood, by motion; at least one.
        width: of the terminal.
    """
    lines = [*wrap_words(_headline(config, stabilities), width), ""]
    end = labelled("rolling", balls, width, _TEXT_LINES) if (balls := simulated_balls(config)) else []
    nominal, kind = nominal_name(config), "URDF" if config.robot.mjcf is None else "MJCF"
    text = f"logs/ and {nominal}; the truth: exact/ and the simulated {kind}"
    end += labelled("to identify", text, width, _TEXT_LINES)
    end.append(f"{'written to':{LABEL}}{config.output}")
    room = LINES - len(lines) - len(end)
    return [*lines, *_motion_lines(config, stabilities, room, width), *end]


def print_all_motions(config: SimulationConfig, stabilities: Mapping[str, Stability]) -> None:
    """Print how the robot stood in every motion."""
    print_rolling(simulated_balls(config))
    print_tables(stability_table({name: asdict(stability) for name, stability in stabilities.items()}))
    print(f"{'written to':{LABEL}}{config.output}")


def _headline(config: SimulationConfig, stabilities: Mapping[str, Stability]) -> str:
    seconds = sum(motion.duration_s for motion in config.motions)
    motions = format_count(len(stabilities), "motion")
    found = stabilities.values()
    slip, margin = 1e3 * max(one.slip for one in found), 1e3 * min(one.zmp_margin for one in found)
    bounds = f"feet slip by at most {slip:.1f} mm, the zero-moment point stays {margin:.0f} mm inside the support"
    effort = max(one.effort for one in found)
    limits = f", torques reach {100 * effort:.0f} % of their limits" if effort else ""
    return f"The robot stands throughout {motions}, {seconds:.4g} s: {bounds}{limits}"


def _motion_lines(config: SimulationConfig, stabilities: Mapping[str, Stability], room: int, width: int) -> list[str]:
    """A table of the motions, the nearest to a bound first, in at most so many lines."""

    def use(one: Stability) -> float:
        """The largest share of a bound that is used up."""
        bounds, margin = config.bounds, one.zmp_margin
        near = bounds.zmp_m / margin if margin > 0.0 else 1.0
        return max(one.slip / bounds.slip_m, one.height_change / bounds.height_m, one.effort, near)

    order = sorted(stabilities, key=lambda name: use(stabilities[name]), reverse=True)
    shown = order[: room - 1 if len(order) < room else room - 2]  # a heading, how many others there are
    found = [stabilities[name] for name in shown]
    columns = [
        ("slip [mm]", [f"{1e3 * one.slip:.1f}" for one in found]),
        ("ZMP inside by [mm]", [f"{1e3 * one.zmp_margin:.0f}" for one in found]),
        ("effort [%]", [f"{100 * one.effort:.0f}" if one.effort else "" for one in found]),
        ("base height [m]", ["{:.3f} to {:.3f}".format(*one.base_height) for one in found]),
        ("feet up [%]", [", ".join(f"{100 * share:.0f}" for share in one.unloaded) for one in found]),
    ]
    lines = column_lines(("motion", shown), columns, width)
    if len(order) > len(shown):
        lines.append(f"and {format_count(len(order) - len(shown), 'motion')} farther from the bounds: --verbose")
    return lines
