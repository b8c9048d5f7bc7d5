"""What holds for every estimator: the same problem in other units, rows or chunks has the same parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from physical import active_case, data, nothing_seen, random_bodies
from synthetic import Array

from torchid.estimators import (
    Consistent,
    ConsistentEstimate,
    ConstrainedEstimate,
    Estimate,
    LeastSquares,
    Sgd,
    SgdEstimate,
    Trainer,
)
from torchid.estimators.conic import Prior
from torchid.estimators.least_squares import FIXED, VERDICTS
from torchid.problem import Batch, LinearProblem
from torchid.problem.linear import parameter_scale

RIDGE = 1e-3


def usual_problem() -> LinearProblem:
    """Two bodies with friction, noisy data that bodies which cannot exist would explain best."""
    problem, scale = active_case(0, rows=60)
    nominal = problem.nominal.reshape(scale.shape).copy()
    nominal[:, 10:] = 0.2
    return replace(problem, nominal=nominal.ravel())


class EstimatorContract(ABC):
    """Inherit it for a new estimator, with a name that starts with Test.

    Attributes:
        kind: of the estimate.
        accuracy: in units of the scale, to which the parameters of a problem are the same again.
        body_by_body: whether the inertial parameters of a body must be free together.
        without_data: of the cases without anything to learn, those that can be solved.
    """

    kind: type[Estimate] = Estimate
    accuracy = 1e-11
    body_by_body = True
    without_data: tuple[str, ...] = ("nothing free", "no rows", "rows of zeros")

    @abstractmethod
    def solve(self, problem: LinearProblem, ridge: float = RIDGE) -> Estimate:
        """Fit the free parameters."""

    def assert_same(self, problem: LinearProblem, phi: Array, expected: Array) -> None:
        """Two parameter vectors, (P,), agree in units of the scale."""
        np.testing.assert_allclose(phi / problem.scale, expected / problem.scale, rtol=0.0, atol=self.accuracy)

    # ---------------------------------------------------------------------------------------------------- the answer

    def test_an_estimate_has_a_figure_for_every_parameter_and_certifies_itself(self) -> None:
        problem = usual_problem()
        estimate = self.solve(problem)
        assert type(estimate) is self.kind
        arrays = ("phi", "standard_error", "observable", "identifiable", "data_share", "verdict")
        assert {getattr(estimate, name).shape for name in arrays} == {(24,)}
        assert estimate.phi.dtype == estimate.standard_error.dtype == np.float64
        assert np.isfinite(estimate.phi).all()
        assert set(estimate.verdict) <= set(VERDICTS)
        assert (estimate.rank, estimate.rows, estimate.oversampling) == (24, 60, 1.0)
        assert estimate.cost == problem.cost(estimate.phi)
        assert estimate.nominal_cost == problem.cost(problem.nominal)
        assert estimate.cost < estimate.nominal_cost

    def test_an_estimate_under_conditions_states_its_objective_above_the_unconstrained_one(self) -> None:
        estimate = self.solve(usual_problem())
        if isinstance(estimate, ConstrainedEstimate):
            assert np.isfinite([estimate.objective, estimate.distance]).all()
            assert estimate.eigenvalues.shape == (2,)
            assert estimate.unconstrained is None or estimate.objective > estimate.unconstrained

    def test_a_problem_is_not_changed_and_solved_again_has_the_same_parameters_to_the_last_bit(self) -> None:
        problem = usual_problem()
        before = {name: np.copy(value) for name, value in vars(problem).items()}
        phi, again = (self.solve(problem).phi for _ in range(2))
        np.testing.assert_array_equal(again, phi)
        for name, value in before.items():
            np.testing.assert_array_equal(getattr(problem, name), value, err_msg=name)

    def test_exact_data_of_bodies_that_exist_give_their_parameters_back(self) -> None:
        rng = np.random.default_rng(3)
        truth, nominal = random_bodies(rng, 2), random_bodies(rng, 2)
        truth[:, 10:], nominal[:, 10:] = 0.3, 0.2
        problem = data(rng, nominal, truth, parameter_scale(nominal), rows=60, spread=3.0, noise=0.0)
        phi = self.solve(problem, ridge=1e-8).phi
        np.testing.assert_allclose(phi / problem.scale, truth.ravel() / problem.scale, rtol=0.0, atol=1e-3)

    # --------------------------------------------------------------------------------- what it must not depend on

    def test_units_of_the_parameters_do_not_matter(self) -> None:
        problem = usual_problem()
        units = 10.0 ** np.random.default_rng(1).uniform(-3.0, 3.0, 24)
        in_units = replace(problem, A=problem.A / units, nominal=problem.nominal * units, scale=problem.scale * units)
        estimate, other = self.solve(problem), self.solve(in_units)
        self.assert_same(problem, other.phi / units, estimate.phi)
        assert other.condition_number == pytest.approx(estimate.condition_number, rel=1e-9)

    def test_the_order_of_the_rows_does_not_matter(self) -> None:
        problem = usual_problem()
        order = np.random.default_rng(2).permutation(60)
        shuffled = replace(problem, A=problem.A[order], b=problem.b[order])
        self.assert_same(problem, self.solve(shuffled).phi, self.solve(problem).phi)

    def test_the_triangular_factor_of_the_rows_is_as_good_as_the_rows(self) -> None:
        problem = usual_problem()
        R = np.linalg.qr(np.column_stack([problem.A, problem.b]), mode="r")
        factor = replace(problem, A=R[:-1, :-1], b=R[:-1, -1], residual=float(R[-1, -1] ** 2))
        estimate, of_factor = self.solve(problem), self.solve(factor)
        self.assert_same(problem, of_factor.phi, estimate.phi)
        assert of_factor.cost == pytest.approx(estimate.cost, rel=max(self.accuracy, 1e-9))

    def test_rows_that_come_twice_say_no_more_than_once(self) -> None:
        """The ridge weighs the prior against the mean over the rows."""
        problem = usual_problem()
        twice = replace(problem, A=np.vstack([problem.A] * 2), b=np.append(problem.b, problem.b), rows=120)
        self.assert_same(problem, self.solve(twice).phi, self.solve(problem).phi)

    # -------------------------------------------------------------------------------------------- the nominal ones

    def test_what_is_not_free_stays_nominal_to_the_last_bit(self) -> None:
        problem = usual_problem()
        free = np.ones((2, 12), dtype=bool)
        free[1, :10], free[0, 10] = False, False
        problem = replace(problem, free=free.ravel())
        estimate = self.solve(problem)
        np.testing.assert_array_equal(estimate.phi[~problem.free], problem.nominal[~problem.free])
        assert (estimate.phi[problem.free] != problem.nominal[problem.free]).all()
        assert not estimate.identifiable[~problem.free].any()
        assert np.isnan(estimate.standard_error[~problem.free]).all()
        assert (estimate.verdict[~problem.free] == FIXED).all()
        assert estimate.rank == problem.free.sum()

    def test_an_endless_ridge_gives_the_nominal_parameters_back(self) -> None:
        problem = usual_problem()
        costs = [self.solve(problem, ridge).cost for ridge in (1e-4, 1e-2, 1.0)]
        assert costs == sorted(costs)
        self.assert_same(problem, self.solve(problem, 1e12).phi, problem.nominal)

    def test_without_anything_to_learn_the_parameters_stay_nominal(self) -> None:
        nominal = random_bodies(np.random.default_rng(10), 1)
        nominal[:, 10:] = 0.2
        problem = nothing_seen(nominal)
        cases = {
            "nothing free": replace(problem, free=np.zeros(12, dtype=bool)),
            "no rows": replace(problem, A=np.zeros((0, 12)), b=np.zeros(0), rows=0),
            "rows of zeros": problem,
        }
        for case in self.without_data:
            estimate = self.solve(cases[case])
            self.assert_same(problem, estimate.phi, problem.nominal)
            assert estimate.rank == 0, case
            assert np.isnan(estimate.condition_number), case
            assert np.isnan(estimate.standard_error).all(), case
            assert not estimate.identifiable.any(), case

    # ---------------------------------------------------------------------------------------------------- refusals

    @pytest.mark.parametrize("ridge", [-1.0, np.nan, np.inf])
    def test_a_ridge_that_is_no_weight_is_refused(self, ridge: float) -> None:
        with pytest.raises(ValueError, match="ridge: found .*; accepted: "):
            self.solve(usual_problem(), ridge)

    def test_a_body_of_which_only_part_is_free_is_refused_where_bodies_count(self) -> None:
        problem = replace(usual_problem(), free=np.arange(24) != 3)
        if not self.body_by_body:
            assert self.solve(problem).phi[3] == problem.nominal[3]
            return
        with pytest.raises(ValueError, match="both free and fixed inertial parameters"):
            self.solve(problem)


class TestLeastSquares(EstimatorContract):
    """The closed form."""

    body_by_body = False

    def solve(self, problem: LinearProblem, ridge: float = RIDGE) -> Estimate:
        """Of the problem as it is."""
        return LeastSquares(ridge).solve(problem)


class ConsistentContract(EstimatorContract):
    """Each prior."""

    kind = ConsistentEstimate
    prior: Prior = "euclidean"

    def solve(self, problem: LinearProblem, ridge: float = RIDGE) -> Estimate:
        """With the usual margin alone."""
        return Consistent(ridge, self.prior).solve(problem)


class TestConsistentEuclidean(ConsistentContract):
    """The default."""


class TestConsistentPullback(ConsistentContract):
    """Lee, Wensing, Park 2020."""

    prior = "pullback"


class TestConsistentEntropic(ConsistentContract):
    """Lee, Park 2018."""

    prior = "entropic"


@pytest.mark.parametrize("estimator", [LeastSquares(), LeastSquares(RIDGE), Consistent(), Consistent(RIDGE)])
def test_the_parameters_alone_are_those_of_the_estimate_to_the_last_bit(estimator: LeastSquares | Consistent) -> None:
    alone, estimate = estimator.minimize(usual_problem()), estimator.solve(usual_problem())
    assert np.array_equal(alone.phi, estimate.phi)
    assert alone.psi is None
    assert estimate.psi is None


class RowBatches:
    """The rows of a problem as mini-batches of samples of one row each: what a `Trainer` needs of `MiniBatches`."""

    def __init__(self, problem: LinearProblem, chunk: int = 1000) -> None:
        rows, columns = problem.A.shape
        self.columns, self.samples, self._chunk = torch.eye(columns, dtype=torch.float64), rows, chunk
        K, f = torch.from_numpy(problem.A)[:, None], torch.from_numpy(problem.b)[:, None]
        still = torch.zeros(rows, 0, dtype=torch.float64)
        self._all = Batch(K, f, torch.ones(rows, 1, 1, dtype=torch.float64), still, still, still)
        self.share = (0, 1)

    def sized_chunks(self) -> Iterator[tuple[Batch, int]]:
        """As `chunks`, with the number of samples."""
        return ((batch, len(batch)) for batch in self.chunks())

    def sized_epoch(self, number: int) -> Iterator[tuple[Batch, int]]:
        """As `epoch`, with the number of samples."""
        return ((batch, len(batch)) for batch in self.epoch(number))

    def chunks(self) -> Iterator[Batch]:
        """All samples, chunk by chunk."""
        return (self._all[start : start + self._chunk] for start in range(0, self.samples, self._chunk))

    def epoch(self, _: int) -> Iterator[Batch]:
        """All samples, always in the same order."""
        return self.chunks()


class TestDescentInLogCholesky(EstimatorContract):
    """Whole steps of LBFGS, which settle; 3e-5 was found."""

    kind = SgdEstimate
    accuracy = 2e-4
    without_data = ("rows of zeros",)  # a descent takes samples, and an optimizer something to move
    settings = Sgd(optimizer={"name": "LBFGS"}, epochs=15, schedule=None)

    def solve(self, problem: LinearProblem, ridge: float = RIDGE) -> Estimate:
        """On the rows of the problem as samples."""
        return Trainer(replace(self.settings, ridge=ridge), problem, RowBatches(problem)).run()

    def test_the_chunks_that_samples_come_in_do_not_matter_to_whole_steps(self) -> None:
        problem = usual_problem()
        in_chunks = Trainer(replace(self.settings, ridge=RIDGE), problem, RowBatches(problem, 25)).run()
        self.assert_same(problem, in_chunks.phi, self.solve(problem).phi)


class TestDescentWithPenalties(TestDescentInLogCholesky):
    """Bodies that only nearly exist; 6e-8 was found."""

    accuracy = 1e-6
    settings = Sgd(optimizer={"name": "LBFGS"}, epochs=15, schedule=None, consistency="penalties")
