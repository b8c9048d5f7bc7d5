"""What `torchid replay` prints: how far the robot drifts from the log, with the URDF's and identified parameters."""

from __future__ import annotations

from torchid.commands.replay import Replay
from torchid.report.tables import terminal_width
from torchid.terminal.lines import LABEL, column_lines, wrap_words

_MOST = 6  # joints in the answer
_SHARES = (0.2, 0.4, 1.0)  # of a window


def print_replay(replayed: Replay, verbose: bool = False) -> None:
    """Print the answer for the terminal's width; `verbose`: with all joints."""
    print("\n".join(replay_lines(replayed, terminal_width(), verbose)))


def replay_lines(replayed: Replay, width: int, verbose: bool = False) -> list[str]:
    """A sentence, the drift at a few times, and the joints that drift most; lines of at most so many columns.

    Args:
        replayed: what was found.
        width: of the terminal.
        verbose: with all joints.
    """
    lines = wrap_words(_sentence(replayed), width, "  ")
    rows = [(name, who) for name in replayed.at(replayed.window) for who in (replayed.of, "identified")]
    columns = [
        (f"{time:g} s", [f"{replayed.at(time)[name][who == 'identified']:.4g}" for name, who in rows])
        for time in (share * replayed.window for share in _SHARES)
    ]
    lines += column_lines(("median drift after", [f"{name}, {who}" for name, who in rows]), columns, width)
    joints = sorted(replayed.by_joint().items(), key=lambda x: -x[1].identified)
    few = joints if verbose else joints[:_MOST]
    cells = [
        (replayed.of, [f"{x.nominal:.4g}" for _, x in few]),
        ("identified", [f"{x.identified:.4g}" for _, x in few]),
    ]
    lines += ["", *column_lines((f"joint, after {replayed.window:g} s", [name for name, _ in few]), cells, width)]
    if len(few) < len(joints):
        lines.append(f"and {len(joints) - len(few)} joints that drift less: --verbose")
    if replayed.output is not None:
        lines.append(f"{'written to':{LABEL}}{replayed.output}")
    return lines


def _sentence(replayed: Replay) -> str:
    """How much less the identified robot drifts."""
    shares = [
        f"{name.partition(' [')[0]} {100.0 * after / before:.2g} %" if before else name
        for name, (before, after) in replayed.at(replayed.window).items()
    ]
    worse = any(after > before for before, after in replayed.at(replayed.window).values())
    head = f"WORSE THAN {replayed.of}: drift" if worse else "Drift"
    driven = "PD targets" if replayed.gains.any() else "torques"
    of = f"of the {driven} of {replayed.source} alone, as a share of the {replayed.of}'s"
    return f"{head} after {replayed.window:g} s {of}: {', '.join(shares)} ({replayed.windows} windows)"
