"""What `torchid evaluate` prints: how much better than the URDF a run predicts other logs, or all errors."""

from __future__ import annotations

from torchid.commands.evaluate import EvaluatedRun
from torchid.commands.verdict import Judged
from torchid.problem.metrics import describe_worse, worse_than_nominal
from torchid.report.tables import error_tables, print_tables, terminal_width
from torchid.terminal.lines import LABEL, error_lines, labelled, wrap_words

MOST_LOGS = 8
"""Logs of which a sentence is printed each: two lines at 80 columns, within a screen."""

_ATTENTION_LINES = 3


def print_evaluation(evaluated: EvaluatedRun) -> None:
    """Print the answer for the terminal's width."""
    print("\n".join(evaluation_lines(evaluated, terminal_width())))


def evaluation_lines(evaluated: EvaluatedRun, width: int) -> list[str]:
    """A sentence by log, the worst first, and of a single log the errors; lines of at most so many columns.

    Args:
        evaluated: of one log or several.
        width: of the terminal.
    """
    of = evaluated.robot.format
    judged = [Judged(name, pair.nominal, pair.identified, of) for name, pair in evaluated.metrics.items()]
    judged.sort(key=_worst, reverse=True)
    lines = [line for one in judged[:MOST_LOGS] for line in wrap_words(_sentence(one), width, "  ")]
    if len(judged) > MOST_LOGS:
        lines.append(f"and {len(judged) - MOST_LOGS} logs that are predicted better than these: --verbose")
    if len(judged) == 1:
        lines += error_lines(judged[0].shown_errors(), width, of)
    if (far := evaluated.far_off()) is not None:
        lines += labelled("attention", far, width, _ATTENTION_LINES)
    left_out = sum(evaluated.excluded.values())
    if left_out:
        lines.append(f"{'left out':{LABEL}}{left_out} samples that torchid check condemns")
    return [*lines, f"{'written to':{LABEL}}{evaluated.output}"]


def print_all_errors(evaluated: EvaluatedRun) -> None:
    """Print the errors of all logs by group of rows."""
    print_tables(*error_tables(evaluated.metrics, evaluated.robot.format))
    print(f"{'written to':{LABEL}}{evaluated.output}")


def _sentence(one: Judged) -> str:
    worse = worse_than_nominal({one.text: (one.nominal, one.identified)})
    return f"WORSE THAN {one.of}: {describe_worse(worse, one.of)}" if worse else one.headline()


def _worst(one: Judged) -> float:
    """The largest error of a group as a share of the URDF's."""
    return max((after / before if before else 1.0 for _, before, after, _ in one.errors()), default=0.0)
