"""What commands on a run print, `evaluate` and `sample`."""

from __future__ import annotations

import numpy as np

from torchid.commands.answer import ErrorComparison
from torchid.commands.evaluate import EvaluatedRun
from torchid.commands.sample import DrawnSamples
from torchid.errors import format_count
from torchid.parameters import COULOMB, MASS, PARAMETERS, PER_BODY, Array
from torchid.problem.metrics import WHITENED, describe_worse, group_name, worse_than_nominal
from torchid.report.parameter_files import table_of_draws
from torchid.report.tables import error_tables, print_tables, terminal_width
from torchid.terminal.lines import LABEL, column_lines, error_lines, labelled, wrap_words

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
    judged = [
        ErrorComparison(name, pair.nominal, pair.identified, of, name in evaluated.at_rest)
        for name, pair in evaluated.metrics.items()
    ]
    judged.sort(key=_worst, reverse=True)
    shown = [_sentence(one, evaluated.explained) for one in judged[:MOST_LOGS]]
    lines = [line for sentence in shown for line in wrap_words(sentence, width, "  ")]
    if len(judged) > MOST_LOGS:
        lines.append(f"and {len(judged) - MOST_LOGS} logs that are predicted better than these: --verbose")
    if len(judged) == 1:
        lines += error_lines(judged[0].shown_errors(), width, of)
    for name, errors in evaluated.with_residual.items():
        without = evaluated.metrics[name].identified
        pairs = [(x, errors.rms_of(x), without.rms_of(x)) for x in ("joint_torque", WHITENED)]
        said = [f"{group_name(x)} {a:.3g}, without it {b:.3g}" for x, a, b in pairs if a is not None and b is not None]
        lines += wrap_words(f"{name} with the learned module: {'; '.join(said)}", width, "  ")
    if (far := evaluated.far_off()) is not None:
        lines += labelled("attention", far, width, _ATTENTION_LINES)
    left_out = sum(evaluated.excluded.values())
    if left_out:
        lines.append(f"{'left out':{LABEL}}{left_out} samples that torchid check rejects")
    return [*lines, f"{'written to':{LABEL}}{evaluated.output}"]


def print_all_errors(evaluated: EvaluatedRun) -> None:
    """Print the errors of all logs by group of rows."""
    print_tables(*error_tables(evaluated.metrics, evaluated.robot.format))
    print(f"{'written to':{LABEL}}{evaluated.output}")


def _sentence(one: ErrorComparison, explained: bool) -> str:
    worse = worse_than_nominal({one.text: (one.nominal, one.identified)})
    own = "" if explained else "; residuals of the run's own logs are not noise alone"
    return f"WORSE THAN {one.of}: {describe_worse(worse, one.of)}" if worse else f"{one.headline()}{own}"


def _worst(one: ErrorComparison) -> float:
    """The largest error of a group as a share of the URDF's."""
    return max((after / before if before else 1.0 for _, before, after, _ in one.errors()), default=0.0)


_ENDS = (0.025, 0.5, 0.975)
_FEWEST_FOR_TAILS = 40  # draws of which one is beyond each end of a 95 % range
_MOST_PARAMETERS = 5  # bodies and joints in the answer


def print_samples(drawn: DrawnSamples, verbose: bool = False) -> None:
    """Print the answer for the terminal's width; `verbose`: with all parameters."""
    print("\n".join(sample_lines(drawn, terminal_width(), verbose)))


def sample_lines(drawn: DrawnSamples, width: int, verbose: bool = False) -> list[str]:
    """A sentence, and the ranges that are widest; lines of at most so many columns."""
    fitted, table = drawn.fitted, table_of_draws(drawn.samples)
    few = len(table) < _FEWEST_FOR_TAILS
    ends, titles = ((0.0, 0.5, 1.0), ("least", "median", "largest")) if few else (_ENDS, ("2.5 %", "median", "97.5 %"))
    total = np.quantile(table[:, MASS : len(fitted.posterior.nominal) : PER_BODY].sum(axis=1), ends)
    lines = wrap_words(
        f"{format_count(len(table), 'robot')} that can exist; {'all' if few else '95 % of them'} weigh {total[0]:.4g} "
        f"to {total[2]:.4g} kg. "
        f"Prior: nominal bodies may be off by {100.0 * drawn.prior_error:.3g} % (--prior-error).",
        width,
        "  ",
    )
    found = fitted.nominal_error
    if found is not None and found.prior_is_narrow and drawn.prior_error < found.value:
        lines += wrap_words(f"  {found}: ranges are too narrow; --prior-error auto takes that.", width, "  ")
    numbers = _shown(drawn, table, verbose)
    ranges = np.quantile(table[:, numbers], ends, axis=0)
    names = [fitted.parameter_names[number] for number in numbers]
    columns = [(title, [f"{x:.4g}" for x in row]) for title, row in zip(titles, ranges, strict=True)]
    lines += column_lines(("widest, in SI units" if not verbose else "parameter", names), columns, width)
    where = "no file: --output samples.npz, ranges.json or, with --format urdf, a folder"
    return [*lines, f"{'written to':{LABEL}}{where if drawn.output is None else drawn.output}"]


def _shown(drawn: DrawnSamples, table: Array, verbose: bool) -> list[int]:
    """Numbers of the parameters that are shown: of masses and Coulomb friction those that range most."""
    posterior = drawn.fitted.posterior
    if verbose:
        return [*np.flatnonzero(posterior.free).tolist(), *range(len(posterior.nominal), table.shape[1])]
    relative = np.zeros(len(posterior.nominal))
    relative[posterior.free] = (table.std(axis=0)[: len(relative)] / posterior.scale)[posterior.free]
    out = []
    for parameter in (MASS, COULOMB):
        of_bodies = np.arange(parameter, len(relative), len(PARAMETERS))
        widest = of_bodies[np.argsort(-relative[of_bodies], kind="stable")][:_MOST_PARAMETERS]
        out += sorted(number for number in widest.tolist() if relative[number] > 0.0)
    return [*out, *range(len(posterior.nominal), min(table.shape[1], len(posterior.nominal) + _MOST_PARAMETERS))]
