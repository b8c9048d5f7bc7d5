"""All that a run says of a fit."""

from __future__ import annotations

from dataclasses import asdict

from torchid.commands.results import Identification
from torchid.commands.training import body_eigenvalues
from torchid.errors import join_names
from torchid.estimators import ConsistentEstimate, ConstrainedEstimate, Estimate, SgdEstimate
from torchid.fitting.cross_validation import CrossValidation
from torchid.fitting.misfit import Misfit
from torchid.problem.metrics import ADVICE, DECISIVE_GROUPS, WorseThanNominal, describe_errors, describe_worse
from torchid.report.tables import (
    contribution_table,
    error_tables,
    extra_table,
    print_tables,
    state_table,
    terminal_width,
    verdict_counts_table,
    verdict_table,
    violation_table,
)
from torchid.terminal.lines import print_labelled, print_noise, print_rolling, wrap_words

_NAMED = 6  # conditions


def print_details(run: Identification) -> None:
    """Print all tables, and the key figures one per line."""
    estimate, robot = run.estimate, run.experiment.robot
    if run.worse:
        _print_worse(run.worse, robot.format)
    if not run.misfit.explained:
        _print_misfit(run.misfit)
    print_tables(state_table([asdict(state) for state in run.states]), *error_tables(run.metrics, robot.format))
    if 0 < run.evaluated["train"] < run.samples:
        count = f"{run.evaluated['train']} of {run.samples} samples, evenly spaced"
        print_labelled("train", f"errors of forces of {count}")
    print_tables(
        contribution_table(run.contributions),
        verdict_table(robot.body_names, estimate.verdict),
        verdict_counts_table(run.by_state, estimate),
    )
    print_noise(run.noise)
    if run.extras:
        print_tables(extra_table(run.extras))
    if run.violations:
        print_tables(violation_table(run.violations_by_name()))
        if type(estimate) is Estimate:
            print("estimator.name=consistent finds the best parameters that break none of them")
    _print_fit(run)
    timed = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in run.seconds.items())
    print_labelled("time", f"{run.samples} samples: {timed}")
    if run.reused:
        print_labelled("from cache", ", ".join(run.reused))
    print(f"written to    {run.experiment.config.output}")


def _print_wrapped(text: str, indent: str = "") -> None:
    print(indent + "\n".join(wrap_words(text, terminal_width() - len(indent), "  ")))


def _print_worse(worse: list[WorseThanNominal], of: str) -> None:
    for line in (
        f"WORSE THAN {of}: {describe_worse(worse, of)}",
        f"{ADVICE}; the results are written all the same, status 0",
    ):
        _print_wrapped(line)


def _print_misfit(misfit: Misfit) -> None:
    _print_wrapped(f"NOT EXPLAINED: the model does not explain these forces: {misfit}")
    if misfit.error_growth is not None and misfit.error_growth > 1.0:
        advice = "look for friction, compliance or contacts that the model lacks, and for wrong sensors (torchid check)"
        growth = f"standard errors are {misfit.error_growth:.2g} times (median) what noise alone would make of them"
        _print_wrapped(f"{growth}; {advice}", "  ")


def _print_fit(run: Identification) -> None:
    """Print the key figures, one per line."""
    estimate, robot = run.estimate, run.experiment.robot
    print_rolling(run.experiment.rolling)
    print_labelled("parameters", f"{estimate.rank} independent combinations of {int(estimate.phi.size)} identified")
    print_labelled("condition", f"{estimate.condition_number:.3g}")
    rest = "" if run.misfit.expected is None else f"; {run.misfit.expected:.3g} are left by noise alone"
    print_labelled("residual", f"{estimate.residual_std:.3g} standard deviations of that noise{rest}")
    if run.motion_noise.combinations:
        print_labelled("motion noise", str(run.motion_noise))
    if run.validation is not None:
        _print_validation(run.validation, run.experiment.robot.format)
    for name, choice in {**run.choices.by_name(), "ridge": run.ridge}.items():
        if choice is not None:
            print_labelled(name, str(choice))
    _print_conditions(run)
    if isinstance(estimate, SgdEstimate):
        print_labelled("training", f"{estimate.epochs} epochs, parameters of epoch {estimate.best_epoch}")
    print_labelled("total mass", f"{run.mass} ({robot.format}: {run.mass.nominal:.3f} kg)")
    if run.robust is not None:
        kept = f"{100 * run.robust.mean_weight:.3g} % of the weight kept"
        print_labelled("robust", f"{run.robust.loss}, {kept}, {run.robust.passes} passes")
    if robot.massless:
        print_labelled("left out", f"massless: {', '.join(robot.massless)}")


def _print_conditions(run: Identification) -> None:
    """How the conditions of physical consistency are met, and what they cost."""
    estimate, robot = run.estimate, run.experiment.robot
    least, body = min((value, name) for name, value in body_eigenvalues(robot, estimate.phi).items())
    print_labelled("consistency", f"smallest eigenvalue of a scaled pseudo-inertia {least:.3g}, {body}")
    if isinstance(estimate, ConstrainedEstimate) and estimate.relative_increase is not None:
        print_labelled("objective", f"{100.0 * estimate.relative_increase:.3g} % above the least without conditions")
    if isinstance(estimate, ConsistentEstimate) and estimate.active:
        print_labelled("at bounds", f"{len(estimate.active)}: {join_names(estimate.active, _NAMED)}")
    if isinstance(estimate, ConsistentEstimate) and estimate.certified_gap is not None:
        print_labelled("certified", f"objective within {estimate.certified_gap:.1g} of the other method's")


def _print_validation(validation: CrossValidation, nominal_of: str) -> None:
    identified, nominal = validation.identified, validation.nominal
    texts = (describe_errors(group, identified.rms_of(group), nominal.rms_of(group)) for group in DECISIVE_GROUPS)
    text = f"each of {validation.folds} blocks, against {nominal_of}: {'; '.join(filter(None, texts))}"
    print_labelled("held out", text)
