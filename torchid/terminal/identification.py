"""What commands on a run print: `identify` the answer on one screen or all of it, `compress`, `evaluate`, `sample`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from textwrap import shorten

import numpy as np
from rich.table import Table

from torchid.commands.answer import ErrorComparison, answer
from torchid.commands.compress import CompressedFile, Compression
from torchid.commands.evaluate import EvaluatedRun
from torchid.commands.run_folder import Identification
from torchid.commands.sample import DrawnSamples
from torchid.commands.training import body_eigenvalues
from torchid.errors import format_count, join_names
from torchid.estimators import ConsistentEstimate, ConstrainedEstimate, Estimate, SgdEstimate
from torchid.estimators.least_squares import COMBINED, FIXED, IDENTIFIED, PRIOR, UNOBSERVABLE
from torchid.parameters import COULOMB, FIRST_MOMENT, MASS, PARAMETERS, PER_BODY, VISCOUS, Array
from torchid.problem.metrics import (
    PRESSURE,
    WHITENED,
    describe_errors,
    describe_worse,
    group_name,
    worse_than_nominal,
)
from torchid.report.parameter_files import table_of_draws
from torchid.report.tables import (
    CUT,
    LABEL,
    LINES,
    column_lines,
    contribution_table,
    error_lines,
    error_tables,
    extra_table,
    labelled,
    noise_advice,
    noise_parts,
    rolling_lines,
    rows_within,
    state_table,
    verdict_counts_table,
    verdict_table,
    violation_table,
    wrap_words,
    written_line,
)
from torchid.reprs import decimal
from torchid.robot import Robot
from torchid.sensing.sensors import minimized_errors

_MOST_ATTENTION = 2
_TEXT_LINES = 2
_ATTENTION_LINES = 3
_FEWEST_LINES = 4  # of the table of bodies: a heading, a body, how many others there are, what the marks mean
_LEGEND = {
    COMBINED: "+ identified only in sums with other bodies",
    PRIOR: "p mostly from the {of}",
    UNOBSERVABLE: ". unobservable",
}
_MOST_DIGITS = 5  # behind the point
_MARKS = {IDENTIFIED: " ", COMBINED: "+", PRIOR: "p", UNOBSERVABLE: ".", FIXED: "="}


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
    lines += labelled("terms", said.terms, width, 1) if said.terms else []
    lines += rolling_lines(run.experiment.rolling, width, _TEXT_LINES)
    for text, most in zip(said.attention, (_ATTENTION_LINES, *[_TEXT_LINES] * (_MOST_ATTENTION - 1)), strict=False):
        lines += labelled("attention", text, width, most)
    if len(said.attention) > _MOST_ATTENTION:
        lines += labelled("", f"{len(said.attention) - _MOST_ATTENTION} more: --verbose", width, _TEXT_LINES)
    output = run.experiment.config.output
    end = [] if output is None else [written_line(output)]
    end += [line for label, text in last for line in labelled(label, text, width, _TEXT_LINES)]
    if len(lines) + len(end) > LINES:
        lines = [line for line in lines if not line.startswith(group_name(PRESSURE))]
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
    names = [robot.body_names[k] for k in shown]
    columns = _columns(robot, estimate, shown)
    lines = column_lines(("body", names), columns, width)
    marks = {word for line in lines[1:] for word in line.split()[1:]}
    if len(free) > len(shown):
        what = "mass" if (estimate.phi.reshape(-1, PER_BODY) != robot.nominal)[free, MASS].any() else "friction"
        lines.append(f"and {len(free) - len(shown)} bodies with a smaller change of {what}: --verbose")
    legend = [text.format(of=robot.format) for verdict, text in _LEGEND.items() if _MARKS[verdict] in marks]
    legend += ["± 1 sigma"] * any("±" in line for line in lines)
    return [*lines, *([shorten("; ".join(legend), width, placeholder=CUT)] if legend else [])]


def _most_changed(robot: Robot, estimate: Estimate, bodies: Sequence[int]) -> list[int]:
    """The bodies whose mass moved most, or else whose Coulomb friction did."""
    phi = estimate.phi.reshape(-1, PER_BODY)
    nominal = robot.nominal
    moved = np.abs(phi - nominal)
    return sorted(bodies, key=lambda k: (-moved[k, MASS], -moved[k, COULOMB], k))


def _columns(robot: Robot, estimate: Estimate, bodies: Sequence[int]) -> list[tuple[str, list[str]]]:
    """Headings and cells, the most important first."""
    phi, error = (x.reshape(-1, PER_BODY) for x in (estimate.phi, estimate.standard_error))
    verdict = estimate.verdict.reshape(-1, PER_BODY)
    nominal = robot.nominal

    def cells(parameter: int) -> list[str]:
        if parameter != MASS and set(verdict[:, parameter]) <= {FIXED, UNOBSERVABLE}:
            return [""] * len(bodies)  # friction, which sensors outside of the joints do not see
        return [_cell(*(x[k, parameter] for x in (phi, error, verdict))) for k in bodies]

    masses = [
        cell if "±" in cell or not cell else f"{decimal(phi[k, MASS])} {cell[-1]}"
        for k, cell in zip(bodies, cells(MASS), strict=True)
    ]

    joints = [robot.bodies[k].joint for k in bodies]
    kinds = {joint.kind for joint in joints if joint is not None}
    force = "N m" if "prismatic" not in kinds else "N m, N"
    moved = [_center_moved(nominal[k], phi[k], verdict[k]) for k in bodies]
    return [
        ("mass [kg]", masses),
        (f"{robot.format} [kg]", [decimal(nominal[k, MASS]) for k in bodies]),
        ("CoM moved [mm]", moved),
        (f"Coulomb [{force}]", cells(COULOMB)),
        (f"viscous [{_per_speed(kinds)}]", cells(VISCOUS)),
    ]


def _per_speed(kinds: set[str]) -> str:
    units = ["N m s/rad"] * bool(kinds - {"prismatic"}) + ["N s/m"] * ("prismatic" in kinds)
    return ", ".join(units)


def _cell(value: float, error: float, verdict: str) -> str:
    if verdict == FIXED:
        return ""
    known = verdict == IDENTIFIED and np.isfinite(error) and error > 0.0
    digits = max(1 - int(np.floor(np.log10(error))), 0) if known else 3
    if known and digits <= _MOST_DIGITS:
        text = f"{value:.{digits}f} ± {error:.{digits}f}"
    else:
        text = f"{round(value, digits):.3g} ± {error:.2g}" if known else f"{value:.3f}"
    return f"{text} {_MARKS[verdict]}"


def _center_moved(nominal: Array, phi: Array, verdict: np.ndarray) -> str:
    """Distance between both centres of mass."""
    if (verdict[FIRST_MOMENT] == FIXED).all() or min(nominal[MASS], phi[MASS]) <= 0.0:
        return ""
    distance = np.linalg.norm(phi[FIRST_MOMENT] / phi[MASS] - nominal[FIRST_MOMENT] / nominal[MASS])
    return f"{1e3 * distance:.0f} {_MARKS[COMBINED] if (verdict[FIRST_MOMENT] == COMBINED).any() else ' '}"


_NAMED = 6  # conditions


def detail_parts(run: Identification, width: int, last: Sequence[tuple[str, str]] = ()) -> list[str | Table]:
    """The verdict, all that needs attention, all tables, and the key figures one per line; as `answer_lines`."""
    estimate = run.estimate
    robot = run.experiment.robot
    said = answer(run)
    parts: list[str | Table] = [*wrap_words(said.headline, width)]
    parts += [line for text in said.attention for line in labelled("attention", text, width)]
    if not run.misfit.explained:
        growth = run.misfit.error_growth or 0.0
        errors = f"; standard errors are {growth:.2g} times (median) those of noise alone" * (growth > 1.0)
        parts += labelled("unexplained", f"{run.misfit}{errors}", width)
    parts += [state_table([asdict(state) for state in run.states]), *error_tables(run.metrics, robot.format)]
    if 0 < run.evaluated["train"] < run.samples:
        count = f"{run.evaluated['train']} of {run.samples} samples, evenly spaced"
        parts += labelled("train", f"errors are those of {count}", width)
    parts += [contribution_table(run.contributions), verdict_table(robot.body_names, estimate.verdict)]
    parts += [verdict_counts_table(run.by_state, estimate), *noise_parts(run.noise, width)]
    if run.extras:
        parts.append(extra_table(run.extras))
    if run.violations:
        parts.append(violation_table(run.violations_by_name()))
        if type(estimate) is Estimate:
            parts.append("Use estimator.name=consistent: its parameters meet all conditions.")
    parts += rolling_lines(run.experiment.rolling, width)
    key_figures = (*_fit_texts(run), *_choice_texts({**run.choices.by_name(), "ridge": run.ridge}), *_end_texts(run))
    parts += [line for label, text in key_figures for line in labelled(label, text, width)]
    parts.append(written_line(run.experiment.config.output))
    return [*parts, *(line for label, text in last for line in labelled(label, text, width))]


def _fit_texts(run: Identification) -> Iterator[tuple[str, str]]:
    """Key figures of the fit, with what they are about."""
    estimate = run.estimate
    robot = run.experiment.robot
    sensors = run.experiment.sensors
    weighted = "" if sensors.task_weights is None else ", weighted by estimator.task_weights"
    yield "minimized", minimized_errors(robot, run.experiment.contacts, sensors) + weighted
    yield "parameters", f"{estimate.rank} independent combinations of {int(estimate.phi.size)} identified"
    yield "condition", f"{estimate.condition_number:.3g}"
    noise_alone = "" if run.misfit.expected is None else f"; noise alone gives {run.misfit.expected:.3g}"
    yield "residual", f"{estimate.residual_std:.3g} standard deviations of the noise{noise_alone}"
    if run.motion_noise.combinations:
        yield "motion noise", str(run.motion_noise)
    if run.validation is not None:
        errors = describe_errors(run.validation.nominal, run.validation.identified)
        yield "held out", f"{run.validation.folds} blocks, {robot.format} -> identified: {errors}"


def _choice_texts(choices: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    """Settings that were left to the logs, by name; None for what was stated."""
    return ((name, str(choice)) for name, choice in choices.items() if choice is not None)


def _end_texts(run: Identification) -> Iterator[tuple[str, str]]:
    """How conditions of physical consistency are met and what they cost, the total mass, and the time of each step."""
    estimate = run.estimate
    robot = run.experiment.robot
    least, body = min((value, name) for name, value in body_eigenvalues(robot, estimate.phi).items())
    yield "consistency", f"smallest eigenvalue of a scaled pseudo-inertia {least:.3g}, {body}"
    if isinstance(estimate, ConstrainedEstimate) and estimate.relative_increase is not None:
        yield "objective", f"{100.0 * estimate.relative_increase:.3g} % above the optimum without constraints"
    if isinstance(estimate, ConsistentEstimate) and estimate.active:
        yield "at bounds", f"{len(estimate.active)}: {join_names(estimate.active, _NAMED)}"
    if isinstance(estimate, SgdEstimate):
        yield "training", f"{estimate.epochs} epochs, parameters of epoch {estimate.best_epoch}"
    yield "total mass", answer(run).total_mass
    if run.robust is not None:
        kept = f"{100 * run.robust.mean_weight:.3g} % of the weight kept"
        yield "robust", f"{run.robust.loss}, {kept}, {run.robust.passes} passes"
    if robot.massless:
        yield "massless", f"{', '.join(robot.massless)}: not fitted"
    timed = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in run.seconds.items())
    yield "time", f"{run.samples} samples: {timed}"


def compression_parts(done: Compression, width: int, verbose: bool = False) -> list[str | Table]:
    """The answer; `verbose`: all tables before it, and every file."""
    parts: list[str | Table] = []
    if verbose:
        parts += [state_table([asdict(state) for state in done.states]), *noise_parts(done.noise, width)]
    parts += [*compression_lines(done.files, width, None if verbose else LINES), *rolling_lines(done.rolling, width)]
    texts = [*_choice_texts(done.choices.by_name())]
    if not verbose and done.noise.suggested:
        texts.append(("noise", noise_advice(done.noise.suggested)))
    return [*parts, *(line for text in texts for line in labelled(*text, width)), written_line(done.output)]


def compression_lines(files: Sequence[CompressedFile], width: int, most: int | None = None) -> list[str]:
    """How much was compressed to how little, and the files, in at most so many lines of at most so many columns."""
    samples, size = (sum(x) for x in zip(*((file.samples, file.size) for file in files), strict=True))
    counts = f"{format_count(len(files), 'log')} ({format_count(samples, 'sample')})"
    said = f"{counts} compressed to {size / 1e6:.3g} MB of factors."
    head = wrap_words(said, width)
    room = len(files) + 2 if most is None else most - len(head) - 1  # the folder
    columns = [
        ("samples", [str(file.samples) for file in files]),
        ("kB", [f"{file.size / 1e3:.0f}" for file in files]),
        ("rows", [str(file.rows) for file in files]),
        ("contact states", [str(file.states) for file in files]),
    ]
    return [*head, *rows_within(("file", [file.name for file in files]), columns, width, room, "more files: --verbose")]


MOST_LOGS = 8
"""Logs of which a sentence is printed each: two lines at 80 columns, within a screen."""


def evaluation_lines(evaluated: EvaluatedRun, width: int) -> list[str]:
    """A sentence by log, the worst first, and of a single log the errors; lines of at most so many columns.

    Args:
        evaluated: of one log or several.
        width: of the terminal.
    """
    file_kind = evaluated.robot.format
    judged = [
        ErrorComparison(name, pair.nominal, pair.identified, file_kind, name in evaluated.at_rest)
        for name, pair in evaluated.metrics.items()
    ]
    judged.sort(key=_worst, reverse=True)
    shown = [_sentence(errors, evaluated.explained) for errors in judged[:MOST_LOGS]]
    lines = [line for sentence in shown for line in wrap_words(sentence, width, "  ")]
    if len(judged) > MOST_LOGS:
        lines.append(f"and {len(judged) - MOST_LOGS} logs with smaller errors: --verbose")
    if len(judged) == 1:
        lines += error_lines(judged[0].shown_errors(), width, file_kind)
    for name, errors in evaluated.with_residual.items():
        without = evaluated.metrics[name].identified
        pairs = [(x, errors.rms_of(x), without.rms_of(x)) for x in ("joint_torque", WHITENED)]
        said = [f"{group_name(x)} {a:.3g}, without it {b:.3g}" for x, a, b in pairs if a is not None and b is not None]
        lines += wrap_words(f"{name} with the learned module: {'; '.join(said)}.", width, "  ")
    if (far := evaluated.far_off()) is not None:
        lines += labelled("attention", far, width, _ATTENTION_LINES)
    left_out = sum(evaluated.excluded.values())
    if left_out:
        lines.append(f"{'left out':{LABEL}}{format_count(left_out, 'sample')} that torchid check rejects")
    return [*lines, written_line(evaluated.output)]


def evaluation_parts(evaluated: EvaluatedRun) -> list[str | Table]:
    """The errors of all logs by group of rows."""
    return [*error_tables(evaluated.metrics, evaluated.robot.format), written_line(evaluated.output)]


def _sentence(errors: ErrorComparison, explained: bool) -> str:
    worse = worse_than_nominal({errors.text: (errors.nominal, errors.identified)})
    doubt = "" if explained else " In the run's own logs, residuals are not noise alone: intervals are too narrow."
    return describe_worse(worse, errors.of) or f"{errors.headline()}{doubt}"


def _worst(errors: ErrorComparison) -> float:
    """The largest error of a group as a share of the URDF's."""
    return max((after / before if before else 1.0 for _, before, after, _ in errors.errors()), default=0.0)


_ENDS = (0.025, 0.5, 0.975)
_FEWEST_FOR_TAILS = 40  # draws of which one is beyond each end of a 95 % range
_MOST_PARAMETERS = 5  # bodies and joints in the answer


def sample_lines(drawn: DrawnSamples, width: int, verbose: bool = False) -> list[str]:
    """A sentence, and the ranges that are widest; lines of at most so many columns."""
    fitted = drawn.fitted
    table = table_of_draws(drawn.samples)
    few = len(table) < _FEWEST_FOR_TAILS
    ends, titles = ((0.0, 0.5, 1.0), ("least", "median", "largest")) if few else (_ENDS, ("2.5 %", "median", "97.5 %"))
    total = np.quantile(table[:, MASS : len(fitted.posterior.nominal) : PER_BODY].sum(axis=1), ends)
    weigh = f"{'all' if few else '95 % of them'} weigh {total[0]:.4g} to {total[2]:.4g} kg"
    prior = f"The prior lets each body deviate from the file by {100.0 * drawn.prior_error:.3g} % (--prior-error)"
    robots = f"{format_count(len(table), 'physically consistent robot')}: {weigh}."
    lines = wrap_words(f"{robots} {prior}.", width, "  ")
    nominal_error = fitted.nominal_error
    if nominal_error is not None and nominal_error.prior_is_narrow and drawn.prior_error < nominal_error.value:
        lines += wrap_words(f"{nominal_error}. Ranges are too narrow: use --prior-error auto.", width, "  ")
    numbers = _shown(drawn, table, verbose)
    ranges = np.quantile(table[:, numbers], ends, axis=0)
    names = [fitted.parameter_names[number] for number in numbers]
    columns = [(title, [f"{x:.4g}" for x in row]) for title, row in zip(titles, ranges, strict=True)]
    lines += column_lines(("widest ranges (SI)" if not verbose else "parameter", names), columns, width)
    where = "no file: use --output FILE.npz, FILE.json or a folder"
    return [*lines, written_line(where if drawn.output is None else drawn.output)]


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
