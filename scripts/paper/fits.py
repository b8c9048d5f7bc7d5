"""Compress the logs of one condition once per sensor set, fit any nominal parameters, predict other motions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.estimators import Estimate
from torchid.fitting.experiment import Experiment, batch_estimator
from torchid.fitting.prior_knowledge import conditions_from
from torchid.parameters import Array
from torchid.problem import Evaluation, RowBuilder, Samples, TriangularFactor, linear_problem
from torchid.problem.chunks import chunks_by_state
from torchid.problem.compression import compress_parts, merge, merge_factors
from torchid.problem.contact_state import ContactState, state_name
from torchid.problem.metrics import BASE_ROWS, force_series, null_space_part


@dataclass(frozen=True)
class StateRank:
    """A contact state of the training logs: number of samples, and rank of their rows."""

    name: str
    samples: int
    rank: int


@dataclass(frozen=True)
class CompressedLogs:
    """Groups of logs compressed for one sensor set: a factor per group and contact state."""

    experiment: Experiment
    builder: RowBuilder
    factors: Mapping[str, Mapping[ContactState, TriangularFactor]]
    counts: Mapping[str, Mapping[ContactState, int]]

    def fit(self, groups: Sequence[str], nominals: Sequence[Array], friction: bool) -> list[Estimate]:
        """Parameters from some groups of logs, near each of some nominal ones (L, 12)."""
        factor = merge_factors((factor for group in groups for factor in self.factors[group].values()), self.builder)
        return [self._solve(factor, nominal, friction) for nominal in nominals]

    def ranks(self, groups: Sequence[str], friction: bool) -> list[StateRank]:
        """Rank of each contact state of some groups on its own, most frequent first, and of all together."""
        nominal = self.experiment.robot.nominal
        (together,) = self.fit(groups, [nominal], friction)
        out = []
        for state in {state for group in groups for state in self.factors[group]}:
            factors = (self.factors[group][state] for group in groups if state in self.factors[group])
            samples = sum(self.counts[group].get(state, 0) for group in groups)
            rank = self._solve(merge_factors(factors, self.builder), nominal, friction).rank
            out.append(StateRank(state_name(self.builder.contacts, state), samples, rank))
        out.sort(key=lambda found: -found.samples)
        return [*out, StateRank("together", sum(found.samples for found in out), together.rank)]

    def _solve(self, factor: TriangularFactor, nominal: Array, friction: bool) -> Estimate:
        robot = replace(self.experiment.robot, nominal=nominal)
        settings = self.experiment.config.estimator
        problem = linear_problem(factor, self.builder, robot, friction)
        problem = replace(problem, free=problem.free & ~self.experiment.frozen())
        return batch_estimator(settings, conditions_from(settings, robot)).solve(problem)


def compress_groups(experiment: Experiment, groups: Mapping[str, Sequence[Samples]]) -> CompressedLogs:
    """Compress groups of logs with an experiment's sensors."""
    builder = RowBuilder(experiment.robot, experiment.contacts, experiment.sensors).to(experiment.config.device)
    parts = {name: merge(compress_parts(logs, builder), builder, "state") for name, logs in groups.items()}
    factors = {name: {part.state: part.factor for part in by_state} for name, by_state in parts.items()}
    counts: dict[str, dict[ContactState, int]] = {name: {} for name in groups}
    for name, logs in groups.items():
        for samples in logs:
            for state, index in chunks_by_state(samples):
                counts[name][state] = counts[name].get(state, 0) + len(samples[index])
    return CompressedLogs(experiment, builder, factors, counts)


@dataclass(frozen=True)
class Series:
    """Generalized forces of one log: `true` (N, n_rows) and what every parameter vector predicts.

    `projected_true` and `projected` are the same inside the contacts' null space, V_x V_x^T f. `rows`: names of the
    rows.
    """

    time: Array
    rows: tuple[str, ...]
    true: Array
    predicted: Mapping[str, Array]
    projected_true: Array
    projected: Mapping[str, Array]

    def row(self, name: str) -> int:
        """Index of a row."""
        return self.rows.index(name)


def predict_series(evaluation: Evaluation, samples: Samples, phi: Mapping[str, Array]) -> Series:
    """Forces of a log and the predictions of named parameter vectors (12 L,)."""
    true, predicted = force_series(evaluation.builder, samples, np.stack(list(phi.values())))
    inside = null_space_part(evaluation.builder, samples, np.concatenate([true[None], predicted]))
    return Series(
        samples.time.numpy() - float(samples.time[0]),
        (*BASE_ROWS, *evaluation.robot.joint_names),
        true,
        dict(zip(phi, predicted, strict=True)),
        inside[0],
        dict(zip(phi, inside[1:], strict=True)),
    )
