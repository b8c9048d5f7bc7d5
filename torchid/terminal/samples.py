"""What `torchid sample` prints: how far masses, friction and actuator terms range."""

from __future__ import annotations

import numpy as np

from torchid.commands.sample import DrawnSamples
from torchid.errors import format_count
from torchid.parameters import COULOMB, MASS, PARAMETERS, PER_BODY, Array
from torchid.report.sample_files import sample_table
from torchid.report.tables import terminal_width
from torchid.terminal.lines import LABEL, column_lines, wrap_words

_ENDS = (0.025, 0.5, 0.975)
_MOST = 5  # bodies and joints in the answer


def print_samples(drawn: DrawnSamples, verbose: bool = False) -> None:
    """Print the answer for the terminal's width; `verbose`: with all parameters."""
    print("\n".join(sample_lines(drawn, terminal_width(), verbose)))


def sample_lines(drawn: DrawnSamples, width: int, verbose: bool = False) -> list[str]:
    """A sentence, and the ranges that are widest; lines of at most so many columns.

    Args:
        drawn: the samples.
        width: of the terminal.
        verbose: with all parameters.
    """
    fitted, table = drawn.fitted, sample_table(drawn.samples)
    total = np.quantile(table[:, MASS : len(fitted.posterior.nominal) : PER_BODY].sum(axis=1), _ENDS)
    lines = wrap_words(
        f"{format_count(len(table), 'sample')}, each inside all conditions; 95 % of them have a total mass of "
        f"{total[0]:.4g} to {total[2]:.4g} kg. Prior: {100.0 * drawn.prior_error:g} % of each body.",
        width,
        "  ",
    )
    numbers = _shown(drawn, table, verbose)
    ranges = np.quantile(table[:, numbers], _ENDS, axis=0)
    names = [fitted.parameter_names[number] for number in numbers]
    columns = [
        (title, [f"{x:.4g}" for x in row]) for title, row in zip(("2.5 %", "median", "97.5 %"), ranges, strict=True)
    ]
    lines += column_lines(("widest, masses and friction" if not verbose else "parameter", names), columns, width)
    if drawn.output is not None:
        lines.append(f"{'written to':{LABEL}}{drawn.output}")
    return lines


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
        widest = of_bodies[np.argsort(-relative[of_bodies], kind="stable")][:_MOST]
        out += sorted(number for number in widest.tolist() if relative[number] > 0.0)
    return [*out, *range(len(posterior.nominal), min(table.shape[1], len(posterior.nominal) + _MOST))]
