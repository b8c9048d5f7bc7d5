"""The stop for fits that no robot can have left, and what the checks of the training logs say of the reason."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from torchid.analysis.known import TotalMass, total_mass
from torchid.analysis.plausible import implausible
from torchid.errors import ImplausibleFitError, InputError, NumericalWarning, SensorError
from torchid.hygiene import Finding, check
from torchid.hygiene.finding import SEVERITIES
from torchid.report.verdict import ADVICE, Worse, verdict
from torchid.run.check import log_to_check
from torchid.run.experiment import Scene
from torchid.run.fit import Fit

_UNEXPLAINED = 5.0  # residual in units of the stated noise; recorded logs with honest noise figures stay below 2
_SHARE = 0.5  # and of the weighted forces, where the noise was estimated to be as large; recorded logs stay below 0.35
_GENERAL = ("forces", "weight")  # findings that say that something is off rather than what
_PART = 0.05  # share of a log's samples from which on a finding may be the reason
_USUAL = (
    "torques or wrenches of the opposite sign, a world whose z axis points down, flags of other contacts, a quaternion "
    "in another order, another unit, or masses in the URDF that are no masses"
)


def check_plausible(fit: Fit, scene: Scene, source: object) -> TotalMass:
    """Stop at a fit that no robot can have left, and warn of one that leaves much more than the stated noise.

    Returns:
        How well the total mass is known.

    Raises:
        SensorError: no parameter is in reach of the sensors.
        ImplausibleFitError: parameters that nobody would print, or forces that no parameters explain in a log that
            the checks condemn.

    Warns:
        NumericalWarning: forces that no parameters explain, for whatever reason.
    """
    estimate = fit.estimate
    if not estimate.rank:
        raise SensorError(source, "sensors", "no parameter is in reach of them", "other sensors, contacts or logs")
    mass = total_mass(fit.assembly, estimate, scene.config.estimator.rank_tolerance)
    absurd = implausible(fit.assembly.problem, estimate.phi, mass, scene.robot)
    unexplained = _unexplained(fit)
    if absurd is None and unexplained is None:
        return mass
    log, finding = next(_findings(scene), (None, None))
    if finding is not None and (absurd is not None or finding.condemns_all):
        told = f"{log}: {finding.field}: {finding.found}"
        raise ImplausibleFitError(
            source, "logs", f"{absurd or unexplained}; torchid check finds in {told}", finding.advice
        )
    if absurd is not None:
        raise ImplausibleFitError(source, "logs", absurd, f"data and URDF that fit each other; usual reasons: {_USUAL}")
    named = "" if finding is None else f"; torchid check finds in {log}: {finding.field}: {finding.found}"
    advice = "check units, frames, quaternion order and contact_active, or state the noise that there is"
    warnings.warn(f"{source}: {unexplained}{named}; {advice}", NumericalWarning, stacklevel=3)
    return mass


def check_not_worse(found: list[Worse], scene: Scene, source: object) -> None:
    """Stop where the URDF's parameters predict better and the checks condemn a training log; else say so.

    Raises:
        ImplausibleFitError: the parameters of a log that is not usable.

    Warns:
        NumericalWarning: the URDF's parameters predict better, for whatever reason.
    """
    if not found:
        return
    told, advice = verdict(found), ADVICE
    log, finding = next(_findings(scene), (None, None))
    if finding is not None:
        told, advice = f"{told}; torchid check finds in {log}: {finding.field}: {finding.found}", finding.advice
        if finding.condemns_all:
            raise ImplausibleFitError(source, "logs", told, advice)
    warnings.warn(f"{source}: {told}; {advice}", NumericalWarning, stacklevel=3)


def _unexplained(fit: Fit) -> str | None:
    """In words how much more than noise the best parameters leave, None if they do not."""
    estimate, problem = fit.estimate, fit.assembly.problem
    left = np.sqrt(estimate.cost / max(estimate.rows, 1))  # not corrected for the fit, which may be far from the best
    if left > _UNEXPLAINED:
        return f"forces differ from any rigid-body model by {left:.3g} times the stated sensor noise"
    share = np.sqrt(estimate.cost / max(problem.cost(np.zeros_like(estimate.phi)), np.finfo(float).tiny))
    if share > _SHARE:
        return f"no rigid-body model explains {100.0 * share:.3g} % of the weighted forces"
    return None


def _findings(scene: Scene) -> Iterator[tuple[str, Finding]]:
    """What training logs suffer from as a whole or in a good part, the most telling first."""
    files = scene.config.logs
    if files is None:
        return
    found = []
    for path in files.train:
        try:
            log = log_to_check(path, files.topics, scene.config.preprocessing)
            checked = check(log, scene.robot, scene.contacts, scene.config.preprocessing.cutoff_hz)
        except InputError:  # larger than memory: nothing is known of it
            continue
        grave = (one for one in checked.findings if one.severity in SEVERITIES[:2])
        found += [(path.name, one) for one in grave if one.mask(len(checked.log)).mean() > _PART]
    yield from sorted(found, key=lambda pair: _order(pair[1]))


def _order(finding: Finding) -> tuple[bool, int, bool]:
    return not finding.whole, SEVERITIES.index(finding.severity), finding.name in _GENERAL
