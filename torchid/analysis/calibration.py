"""What offsets and scales of sensors, and terms of actuators, are, and which of them cannot be told from masses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchid import parameters
from torchid.analysis.known import APART, ROUNDING, Known
from torchid.estimators.result import Estimate
from torchid.parameters import Array
from torchid.problem.elimination import Assembly, Elimination
from torchid.problem.extras import Extra
from torchid.problem.rows import RowBuilder
from torchid.problem.streaming import Part, merged
from torchid.problem.threads import one_thread

_NAMED = 4  # parameters, at most, that a message names
_CONTRADICTS = 5.0  # standard errors between a reading in the air and what the ground says of it; noise is seldom white
_NOTICEABLE = 3.0  # standard deviations of the sensor's noise: what no single reading shows is not worth a word


@dataclass(frozen=True)
class ExtraEstimate:
    """An unknown beside the bodies' parameters, found.

    Attributes:
        extra: which.
        log: whose, "" of all.
        value: in its unit.
        nominal_value: the one that would fit best if the bodies' parameters were the nominal ones.
        standard_error: without the pull to nominal parameters, infinite where the data do not determine it.
        inflation: of the standard error by not knowing all other unknowns and parameters, at least 1.
        mixed_with: what it cannot be told from, most first; empty if it can.
    """

    extra: Extra
    log: str
    value: float
    nominal_value: float
    standard_error: float
    inflation: float
    mixed_with: tuple[str, ...]

    @property
    def told_apart(self) -> bool:
        """Whether the data tell it from everything else."""
        return self.inflation <= APART


@one_thread()
def estimate_extras(
    assembly: Assembly, estimate: Estimate, body_names: Sequence[str], rank_tolerance: float = 1e-10
) -> list[ExtraEstimate]:
    """All unknowns that were eliminated, at the estimated parameters; those that no row has are left out.

    Args:
        assembly: from `assemble`.
        estimate: of its problem.
        body_names: the robot's.
        rank_tolerance: as in `LeastSquares`.
    """
    if not assembly.eliminations:
        return []
    known, names = Known.of(assembly.problem, rank_tolerance), _names(assembly.problem.free, body_names)
    noise = float(np.sqrt(assembly.problem.oversampling) * estimate.residual_std)
    shared = next((found for found in assembly.eliminations if not found.log), None)
    values = zip(assembly.unknowns(estimate.phi), assembly.unknowns(assembly.problem.nominal), strict=True)
    out = []
    for found, pair in zip(assembly.eliminations, values, strict=True):
        out += _found(found, pair, noise, known, names, shared if found.log else None)
    return out


def _found(
    found: Elimination,
    values: tuple[Array, Array],
    noise: float,
    known: Known,
    names: Sequence[str],
    shared: Elimination | None,
) -> list[ExtraEstimate]:
    """The unknowns of one elimination, at identified and nominal parameters; `shared`: those they depend on."""
    P = len(known.free)
    sensitivity, own, hidden = found.inverse @ found.C[:, :P], [found.inverse], [found.hidden]
    if shared is not None:
        through = found.inverse @ found.C[:, P:]
        sensitivity = sensitivity - through @ shared.inverse @ shared.C[:, :P]
        own.append(through @ shared.inverse)
        hidden.append(through @ shared.hidden)
    G = known.reached(sensitivity)
    unseen = G @ known.hidden
    size = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny)
    lost = np.linalg.norm(unseen, axis=1) > ROUNDING * size
    through_parameters = ((G @ known.root) ** 2).sum(1)
    variance = sum((x**2).sum(1) for x in own) + through_parameters
    undetermined = lost | ~found.determined | (np.linalg.norm(np.hstack(hidden), axis=1) > ROUNDING)
    deviation = np.where(undetermined, np.inf, np.sqrt(variance))
    out = []
    for k, extra in enumerate(found.extras):
        if not np.isfinite(found.alone[k]):
            continue
        inflation = float(deviation[k] / found.alone[k])
        mixed: tuple[str, ...] = ()
        if inflation > APART:
            blamed = lost[k] or 2.0 * through_parameters[k] > variance[k]
            mixed = _largest(known.blamed(G[k], noise), names) if blamed else ()
            others = _largest(np.where(np.arange(len(found.extras)) == k, 0.0, found.hidden[k]), _labels(found))
            mixed = (*mixed, *others)
        error = noise * float(deviation[k]) if np.isfinite(deviation[k]) else np.inf
        value, nominal = (float(x[k]) for x in values)
        out.append(ExtraEstimate(extra, found.log, value, nominal, error, inflation, mixed))
    return out


@dataclass(frozen=True)
class Disagreement:
    """An offset that is one thing in the air and another on the ground.

    Attributes:
        extra: the offset.
        log: in which.
        in_the_air: what the sensor reads while nothing touches, in its unit.
        in_contact: what it would read there with the offset, and scale, that suit the rest of the data best.
        standard_error: of the difference.
    """

    extra: Extra
    log: str
    in_the_air: float
    in_contact: float
    standard_error: float

    @property
    def standard_errors(self) -> float:
        """How many of them the two are apart."""
        return abs(self.in_the_air - self.in_contact) / self.standard_error

    def matters(self, noise: Array) -> bool:
        """Whether the two contradict each other, beside the noise (6,) of contact sensors [N, N m]."""
        axis = 0 if self.extra.contact is None else self.extra.contact[1]
        apart = abs(self.in_the_air - self.in_contact)
        return self.standard_errors > _CONTRADICTS and apart > _NOTICEABLE * float(noise[axis])


@one_thread()
def disagreements(
    parts: Sequence[Part], builder: RowBuilder, in_contact: Sequence[ExtraEstimate], noise: float = 1.0
) -> list[Disagreement]:
    """Offsets whose readings in the air contradict all other rows, largest contradiction first.

    Args:
        parts: of the logs.
        builder: of their rows.
        in_contact: unknowns that a fit without the unloaded parts found.
        noise: standard deviation of whitened rows, correlation counted.
    """
    out = []
    for source in dict.fromkeys(part.source for part in parts if part.unloaded):
        own = {(x.extra.what, x.extra.contact): x for x in in_contact if x.log in ("", source)}
        R = merged((part.factor for part in parts if part.unloaded and part.source == source), builder).triangle()
        for number, extra in enumerate(builder.extras, start=builder.columns.count):
            column, offset = R[:, number].numpy(), own.get((extra.what, extra.contact))
            if extra.what == "offset" and extra.contact is not None and offset is not None and column.any():
                weight = float(column @ column)
                read, scale = float(column @ R[:, -1].numpy()) / weight, own.get(("scale", extra.contact))
                expected, variance = offset.value, offset.standard_error**2 + noise**2 / weight
                if scale is not None:
                    expected, variance = expected / (1.0 + scale.value), variance + (read * scale.standard_error) ** 2
                out.append(Disagreement(extra, source, read, expected, float(np.sqrt(variance))))
    sensors = builder.sensors.noise.wrench
    return sorted((x for x in out if x.matters(sensors)), key=lambda x: -x.standard_errors)


def _labels(found: Elimination) -> list[str]:
    return [extra.label for extra in found.extras]


def _largest(along: Array, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the largest components of a direction, none that is small beside them."""
    order = np.argsort(-np.abs(along))[:_NAMED]
    least = max(0.2 * np.abs(along).max(initial=0.0), ROUNDING)
    return tuple(names[k] for k in order if np.abs(along[k]) > least)


def _names(free: np.ndarray, body_names: Sequence[str]) -> list[str]:
    """Names of the free parameters: "pelvis m"."""
    every = [f"{body} {name}" for body in body_names for name in parameters.PARAMETERS]
    return [name for name, chosen in zip(every, free, strict=True) if chosen]
