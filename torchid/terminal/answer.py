"""The answer of a run on one screen: did it work, what is the model, what needs attention."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import shorten

import numpy as np

from torchid.commands.answer import answer
from torchid.commands.results import Identification
from torchid.estimators import Estimate
from torchid.estimators.least_squares import COMBINED, FIXED, IDENTIFIED, PRIOR, UNOBSERVABLE
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.report.tables import terminal_width
from torchid.robot import Robot
from torchid.terminal.lines import CUT, LABEL, LINES, column_lines, error_lines, labelled, wrap_words

_MOST_ATTENTION, _TEXT_LINES, _ATTENTION_LINES = 2, 2, 3
_FEWEST_LINES = 4  # of the table of bodies: a heading, a body, how many others there are, what the marks mean
_MASS, _CENTER = PARAMETERS.index("m"), slice(PARAMETERS.index("mcx"), PARAMETERS.index("mcz") + 1)
_COULOMB, _VISCOUS = PARAMETERS.index("fc"), PARAMETERS.index("fv")
_LEGEND = {COMBINED: "+ known only in sums with other bodies", PRIOR: "p mostly the {of}'s", UNOBSERVABLE: ". unseen"}
_MARKS = {IDENTIFIED: " ", COMBINED: "+", PRIOR: "p", UNOBSERVABLE: ".", FIXED: "="}


def print_answer(run: Identification, *last: tuple[str, str]) -> None:
    """Print it for the terminal's width, with these words and what they are about at the end."""
    print("\n".join(answer_lines(run, terminal_width(), last)))


def answer_lines(run: Identification, width: int, last: Sequence[tuple[str, str]] = ()) -> list[str]:
    """The answer, in lines that are not wider than so many columns.

    Args:
        run: a finished one.
        width: of the terminal.
        last: words, and what they are about, at the end.
    """
    said = answer(run)
    lines = [*wrap_words(said.headline, width), *error_lines(said.errors, width, run.experiment.robot.format), ""]
    lines += labelled("total mass", said.total_mass, width, _TEXT_LINES)
    lines += labelled("bodies", said.bodies, width, _TEXT_LINES)
    for one in said.attention[:_MOST_ATTENTION]:
        lines += labelled("attention", one, width, _ATTENTION_LINES)
    if len(said.attention) > _MOST_ATTENTION:
        lines += labelled("", f"and {len(said.attention) - _MOST_ATTENTION} more: --verbose", width, _TEXT_LINES)
    output = run.experiment.config.output
    end = [] if output is None else [f"{'written to':{LABEL}}{output}"]
    end += [line for one in last for line in labelled(*one, width, _TEXT_LINES)]
    bodies = _body_lines(run.experiment.robot, run.estimate, LINES - len(lines) - len(end) - 1, width)
    return [*lines, *(["", *bodies] if bodies else []), *end]


# --------------------------------------------------------------------------------------------------------- the bodies


def _body_lines(robot: Robot, estimate: Estimate, room: int, width: int) -> list[str]:
    """A table of the bodies that changed most, with as many columns as fit, in so many lines."""
    free = [k for k, row in enumerate(estimate.verdict.reshape(-1, PER_BODY)) if (row != FIXED).any()]
    if room < _FEWEST_LINES:
        return []
    most = room - 2  # heading, legend
    shown = sorted(_most_changed(robot, estimate, free)[: most if len(free) <= most else most - 1])
    names, columns = [robot.body_names[k] for k in shown], _columns(robot, estimate, shown)
    lines = column_lines(("body", names), columns, width)
    marks = {word for line in lines[1:] for word in line.split()[1:]}
    if len(free) > len(shown):
        lines.append(f"and {len(free) - len(shown)} bodies that changed less: parameters.json, --verbose")
    legend = "; ".join(text.format(of=robot.format) for verdict, text in _LEGEND.items() if _MARKS[verdict] in marks)
    return [*lines, *([shorten(legend, width, placeholder=CUT)] if legend else [])]


def _most_changed(robot: Robot, estimate: Estimate, bodies: Sequence[int]) -> list[int]:
    """The bodies whose mass moved by the largest share of the robot's, or else friction by that of its own."""
    phi, nominal = estimate.phi.reshape(-1, PER_BODY), robot.nominal
    moved = np.abs(phi - nominal)
    return sorted(bodies, key=lambda k: (-moved[k, _MASS], -moved[k, _COULOMB], k))


def _columns(robot: Robot, estimate: Estimate, bodies: Sequence[int]) -> list[tuple[str, list[str]]]:
    """Headings and cells, the most important first."""
    phi, error = (x.reshape(-1, PER_BODY) for x in (estimate.phi, estimate.standard_error))
    verdict, nominal = estimate.verdict.reshape(-1, PER_BODY), robot.nominal

    def cells(parameter: int) -> list[str]:
        return [_cell(*(x[k, parameter] for x in (phi, error, verdict))) for k in bodies]

    joints = [robot.bodies[k].joint for k in bodies]
    kinds = {joint.kind for joint in joints if joint is not None}
    force = "N m" if "prismatic" not in kinds else "N m, N"
    moved = [_center_moved(nominal[k], phi[k], verdict[k]) for k in bodies]
    return [
        ("mass [kg]", cells(_MASS)),
        (f"{robot.format} [kg]", [f"{nominal[k, _MASS]:.3f}" for k in bodies]),
        (f"Coulomb [{force}]", cells(_COULOMB)),
        ("CoM moved [mm]", moved),
        (f"viscous [{_per_speed(kinds)}]", cells(_VISCOUS)),
    ]


def _per_speed(kinds: set[str]) -> str:
    units = ["N m s/rad"] * bool(kinds - {"prismatic"}) + ["N s/m"] * ("prismatic" in kinds)
    return ", ".join(units)


def _cell(value: float, error: float, verdict: str) -> str:
    if verdict == FIXED:
        return ""
    known = verdict == IDENTIFIED and np.isfinite(error) and error > 0.0
    digits = min(max(1 - int(np.floor(np.log10(error))), 0), 5) if known else 3
    text = f"{value:.{digits}f} ± {error:.{digits}f}" if known else f"{value:.{digits}f}"
    return f"{text} {_MARKS[verdict]}"


def _center_moved(nominal: Array, phi: Array, verdict: np.ndarray) -> str:
    """Distance between both centres of mass."""
    if (verdict[_CENTER] == FIXED).all() or min(nominal[_MASS], phi[_MASS]) <= 0.0:
        return ""
    distance = np.linalg.norm(phi[_CENTER] / phi[_MASS] - nominal[_CENTER] / nominal[_MASS])
    return f"{1e3 * distance:.0f} {_MARKS[COMBINED] if (verdict[_CENTER] == COMBINED).any() else ' '}"
