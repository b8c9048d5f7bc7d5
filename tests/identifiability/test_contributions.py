"""What the data determine, and what is lost without a log, a contact state or a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from synthetic import SOLO12, UR5, Array, Oracle, load, make_log

from torchid import parameters
from torchid.estimators import LeastSquares
from torchid.estimators.least_squares import VERDICTS
from torchid.identifiability.information import (
    Contributions,
    InformationGain,
    SensorContribution,
    contributions,
    prior_directions,
    sensor_information,
)
from torchid.problem import ExtraTerms, LinearProblem, RowBuilder, Samples, assemble, bind_log, compress, compress_parts
from torchid.problem.compression import Part, merge_factors
from torchid.report.tables import contribution_table, table_text, verdict_table
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, chosen_sensors, named_sensors

NOISE = SensorNoise(0.5, 2.0, 0.2)


def problem_of(A: Array, b: Array, rows: int | None = None) -> LinearProblem:
    P = A.shape[1]
    return LinearProblem(A, b, 0.0, rows or len(b), np.zeros(P), np.ones(P), np.ones(P, dtype=bool))


# -------------------------------------------------------------------------------------------------- shares and verdicts


def test_the_share_of_the_data_is_how_far_the_estimate_follows_the_truth() -> None:
    rng = np.random.default_rng(0)
    A, scale = rng.normal(size=(20, 4)) @ rng.normal(size=(4, 6)), 10.0 ** rng.uniform(-1.0, 1.0, 6)
    problem = replace(problem_of(A / scale, np.zeros(20)), scale=scale, nominal=rng.normal(size=6))
    for ridge in (0.0, 0.1, 3.0):
        shares = LeastSquares(ridge).solve(problem).data_share
        for p in range(6):
            unit = np.eye(6)[p]
            here, there = (LeastSquares(ridge).solve(replace(problem, b=problem.A @ x)) for x in (0.0 * unit, unit))
            assert (there.phi - here.phi)[p] == pytest.approx(shares[p], abs=1e-10)


@pytest.mark.parametrize("rank", [0, 3, 7])
def test_without_a_pull_the_shares_add_up_to_the_rank(rank: int) -> None:
    rng = np.random.default_rng(rank)
    estimate = LeastSquares().solve(problem_of(rng.normal(size=(30, rank)) @ rng.normal(size=(rank, 7)), np.ones(30)))
    assert estimate.data_share.sum() == pytest.approx(rank, abs=1e-10)
    assert len(estimate.singular_values) == 7
    assert (np.diff(estimate.singular_values) <= 0.0).all()


def test_a_pull_takes_shares_from_the_data_until_nothing_is_left() -> None:
    problem = problem_of(np.diag([10.0, 1.0, 0.1]), np.zeros(3))
    shares = [LeastSquares(ridge).solve(problem).data_share for ridge in (0.0, 1e-3, 1.0, 1e3, 1e12)]
    np.testing.assert_allclose(shares[0], 1.0)
    np.testing.assert_allclose(shares[2], [100 / 103, 1 / 4, 0.01 / 3.01])
    np.testing.assert_allclose(shares[-1], 0.0, atol=1e-9)
    assert (np.diff(shares, axis=0) < 0.0).all()


def test_every_parameter_gets_the_verdict_that_its_share_and_the_rows_call_for() -> None:
    """Seen well, seen faintly, two seen only by their sum, never seen, and one that is not free."""
    A = np.array([[1.0, 0, 0, 0, 0, 1.0], [0, 0.1, 0, 0, 0, 1.0], [0, 0, 1.0, 1.0, 0, 1.0]])
    problem = replace(problem_of(A, np.ones(3)), free=np.array([True, True, True, True, True, False]))
    estimate = LeastSquares(0.1).solve(problem)
    expected = ["identified", "dominated by the prior", *["only in combination"] * 2, "unobservable", "fixed"]
    assert estimate.verdict.tolist() == expected
    assert np.isnan(estimate.data_share).tolist() == [False] * 5 + [True]
    assert estimate.verdict_counts() == dict(zip(VERDICTS, (1, 1, 2, 1, 1), strict=True))
    assert LeastSquares().solve(problem).verdict.tolist()[:2] == ["identified"] * 2
    np.testing.assert_allclose(estimate.data_share[4], 0.0, atol=1e-15)


def test_marks_stand_for_verdicts_and_bodies_with_nothing_free_are_left_out() -> None:
    verdicts = np.full((3, parameters.PER_BODY), "fixed", dtype=object)
    verdicts[1, :4] = ["identified", "dominated by the prior", "only in combination", "unobservable"]
    text = table_text(verdict_table(["trunk", "arm", "dummy"], verdicts.flatten()))
    (row,) = [line for line in text.splitlines() if "arm" in line]
    assert row.split() == ["arm", "*", "p", "+", "."]
    assert "dummy" not in text
    assert max(map(len, text.splitlines())) <= 100


# ----------------------------------------------------------------------------------------------------------- the worlds


@dataclass(frozen=True)
class World:
    """A robot, its contacts and sensors, and logs of random states."""

    robot: Robot
    contacts: tuple[Contact, ...]
    sensors: SensorSet
    logs: list[Samples]
    terms: ExtraTerms = ExtraTerms()

    @property
    def builder(self) -> RowBuilder:
        return RowBuilder(self.robot, self.contacts, self.sensors, self.terms)


FEET = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))
STATES = [[True] * 4, [False, True, True, True], [True, False, False, True], [False] * 4]


def quadruped(sensors: SensorSet, samples: Sequence[int] = (24,), states: Sequence[list[bool]] = STATES) -> World:
    robot, rng = load(SOLO12), np.random.default_rng(3)
    oracle, feet = Oracle.of(robot), [(foot.frame, 3) for foot in FEET]
    logs = [make_log(oracle, feet, states, n, rng, f"{number}.npz") for number, n in enumerate(samples)]
    return World(robot, FEET, sensors, [bind_log(log, robot, FEET) for log in logs])


def with_sensors(w: World, torques: Sequence[str], wrenches: Mapping[str, Sequence[str]]) -> World:
    return replace(w, sensors=chosen_sensors(w.robot.joint_names, w.contacts, torques, wrenches, NOISE))


def arm(point: bool) -> World:
    """A bolted arm whose hand touches something in half of the samples."""
    robot, rng = load(UR5, fixed_base=True), np.random.default_rng(4)
    contacts = (Contact("tool0", "point" if point else "flat"),)
    log = make_log(Oracle.of(robot), [("tool0", 3 if point else 6)], [[True], [False]], 40, rng, "arm.npz")
    return World(robot, contacts, named_sensors("full", robot.n, 1, NOISE), [bind_log(log, robot, contacts)])


def gram(w: World) -> Array:
    """Information in the builder's columns, from all rows."""
    R = compress(w.logs, w.builder, threads=1).triangle().numpy()[:-1, :-1]
    return R.T @ R


# ------------------------------------------------------------------------------------------------- a sensor is left out


ALL = ("fx", "fy", "fz")
CASES = {
    "full": ("all", dict.fromkeys((foot.frame for foot in FEET), ALL)),
    "joints": ("all", {}),
    "parts of wrenches": ("all", {"FL_FOOT": ("fz",), "HR_FOOT": ("fx", "fz"), "FR_FOOT": ALL}),
    "some of both": (["FL_HAA", "FL_HFE", "HR_KFE", "HL_HAA"], {"FL_FOOT": ("fy", "fz"), "FR_FOOT": ALL}),
}


@pytest.mark.parametrize("case", [*CASES, "arm", "arm with a point"])
def test_what_a_sensor_adds_is_what_a_problem_rebuilt_without_it_lacks(case: str) -> None:
    if case in CASES:
        torques, wrenches = CASES[case]
        w = quadruped(named_sensors("full", 12, 4))
        torques = w.robot.joint_names if torques == "all" else torques
    else:
        w = arm(point=case == "arm with a point")
        torques, wrenches = w.robot.joint_names[1:], {"tool0": ("fx", "fz") if "point" in case else ("fz", "mx", "my")}
    w = with_sensors(w, torques, wrenches)
    found = sensor_information(w.logs, w.builder)
    whole = gram(w)
    size = np.abs(whole).max()
    np.testing.assert_allclose(found.total, whole, rtol=0.0, atol=1e-12 * size)
    assert [w.robot.joint_names[j] for j in found.torques] == [n for n in w.robot.joint_names if n in torques]
    assert {w.contacts[c].frame for c in found.wrenches} == set(wrenches)
    for joint, lost in found.torques.items():
        rest = [name for name in torques if name != w.robot.joint_names[joint]]
        np.testing.assert_allclose(lost, whole - gram(with_sensors(w, rest, wrenches)), rtol=0.0, atol=1e-10 * size)
        assert np.abs(lost).max() > 1e-6 * size
    for contact, lost in found.wrenches.items():
        fewer = {frame: names for frame, names in wrenches.items() if frame != w.contacts[contact].frame}
        expected = whole - gram(with_sensors(w, torques, fewer))
        np.testing.assert_allclose(lost, expected, rtol=0.0, atol=1e-10 * size)
        assert np.abs(lost).max() > 1e-6 * size


def test_a_foot_in_the_air_adds_nothing_and_a_torque_beside_too_few_others_neither() -> None:
    up = quadruped(named_sensors("full", 12, 4, NOISE), states=[[False, True, True, True]])
    wrenches = sensor_information(up.logs, up.builder).wrenches
    assert not wrenches[0].any()
    assert all(wrenches[foot].any() for foot in (1, 2, 3))
    robot, rng = load(UR5, fixed_base=True), np.random.default_rng(5)
    contacts = (Contact("tool0", "flat"),)
    log = make_log(Oracle.of(robot), [("tool0", 6)], [[True]], 20, rng)
    held = World(robot, contacts, named_sensors("joints", robot.n, 1, NOISE), [bind_log(log, robot, contacts)])
    found = sensor_information(held.logs, held.builder)  # six unknown forces, six torques: nothing is left
    assert not found.total.any()
    assert not any(lost.any() for lost in found.torques.values())


def test_some_samples_stand_for_all() -> None:
    w = quadruped(named_sensors("full", 12, 4, NOISE), samples=(400, 200))
    exact, found = (sensor_information(w.logs, w.builder, most) for most in (4000, 240))
    problem = identified(w)[1]
    N = prior_directions(w.builder, problem.scale * problem.free)
    bits = [InformationGain.of(np.linalg.eigvalsh(N.T @ one.total @ N)).bits for one in (exact, found)]
    assert bits[1] == pytest.approx(bits[0], rel=0.02)
    seen: list[int] = []
    sensor_information(w.logs, w.builder, 240, seen.append)
    assert 200 <= sum(seen) <= 280
    np.testing.assert_allclose(exact.total, gram(w), rtol=0.0, atol=1e-12 * np.abs(exact.total).max())


# --------------------------------------------------------------------------------- a log or a contact state is left out


def identified(w: World, logs: Sequence[Samples] | None = None) -> tuple[list[Part], LinearProblem, RowBuilder]:
    builder = w.builder
    parts = compress_parts(w.logs if logs is None else logs, builder)
    return parts, assemble(parts, builder, w.robot).problem, builder


def adds(w: World) -> Contributions:
    parts, problem, builder = identified(w)
    return contributions(parts, w.logs, builder, problem, w.robot.joint_names)


def knowledge(w: World, logs: Sequence[Samples]) -> tuple[InformationGain, int]:
    """By the definition, from the rows of all parameters; and the rank."""
    _, problem, _ = identified(w, logs)
    A = problem.A[:, problem.free] * problem.scale[problem.free]
    H = A.T @ A / problem.oversampling
    unit = np.eye(len(H))
    bits = 0.5 * np.linalg.slogdet(unit + H).logabsdet / np.log(2.0)
    return InformationGain(bits, np.trace(np.linalg.solve(unit + H, H))), LeastSquares().solve(problem).rank


UNKNOWN = {
    "no more": ExtraTerms(),
    "offsets of logs": ExtraTerms(offsets={"joint_torque": "log"}),
    "offsets and armatures of all": ExtraTerms(offsets={"joint_torque": "all"}, armature=True),
    "some of logs and some of all": ExtraTerms(
        {"joint_torque": "log", "contact_force": "all"}, scales={"contact_force": "log"}, armature=True
    ),
}


@pytest.fixture(scope="module", params=UNKNOWN)
def three_logs(request: pytest.FixtureRequest) -> World:
    """Logs of 4, 9 and 5 samples, cycling through the contact states."""
    terms = UNKNOWN[request.param]
    w = quadruped(named_sensors("full" if terms.scales else "joints", 12, 4, NOISE), samples=(4, 9, 5))
    return replace(w, logs=[replace(log, oversampling=2.5) for log in w.logs], terms=terms)


def test_what_a_log_adds_is_what_a_fit_without_it_lacks(three_logs: World) -> None:
    w, found = three_logs, adds(three_logs)
    whole, rank = knowledge(w, w.logs)
    assert found.total.bits == pytest.approx(whole.bits, rel=1e-9)
    assert found.total.determined == pytest.approx(whole.determined, rel=1e-9)
    assert [log.name for log in found.logs] == ["0.npz", "1.npz", "2.npz"]
    for number, log in enumerate(found.logs):
        rest, rank_of_rest = knowledge(w, w.logs[:number] + w.logs[number + 1 :])
        assert log.bits == pytest.approx((whole - rest).bits, rel=1e-8)
        assert log.determined == pytest.approx((whole - rest).determined, rel=1e-8)
        assert log.samples == len(w.logs[number])
        assert log.rank == knowledge(w, [w.logs[number]])[1]
        assert log.rank_lost == rank - rank_of_rest
    assert found.logs[0].rank < found.logs[1].rank
    assert found.logs[1].rank_lost > 0


def test_what_a_contact_state_adds_is_what_a_fit_without_it_lacks(three_logs: World) -> None:
    w, found = three_logs, adds(three_logs)
    whole, rank = knowledge(w, w.logs)
    names = [" + ".join(f.frame for f, on in zip(FEET, state, strict=True) if on) or "none" for state in STATES]
    assert {state.name for state in found.states} == set(names)
    assert [state.samples for state in found.states] == sorted((s.samples for s in found.states), reverse=True)
    for state in found.states:
        flags = torch.tensor(STATES[names.index(state.name)])
        here = [(log.active == flags).all(dim=1) for log in w.logs]
        rest, rank_of_rest = knowledge(w, [log[~flag] for log, flag in zip(w.logs, here, strict=True)])
        alone = [log[flag] for log, flag in zip(w.logs, here, strict=True)]
        assert state.samples == sum(map(len, alone))
        assert state.rank == knowledge(w, alone)[1]
        assert state.rank_lost == rank - rank_of_rest
        assert state.bits == pytest.approx((whole - rest).bits, rel=1e-8)


def test_a_log_that_repeats_another_loses_no_rank_and_fewer_bits_than_it_holds(three_logs: World) -> None:
    log = three_logs.logs[1]
    twice = replace(three_logs, logs=[log, replace(log, source="again.npz")])
    first, second = adds(twice).logs
    assert first.rank == second.rank > 0
    assert first.rank_lost == second.rank_lost == 0
    alone = adds(replace(three_logs, logs=[log]))
    assert 0.0 < first.bits == pytest.approx(second.bits)
    assert first.bits <= 0.5 * alone.logs[0].rank  # twice the samples: half a bit for every combination, at most


@pytest.mark.parametrize("unknown", UNKNOWN)
def test_sensors_are_ranked_by_what_a_fit_without_them_lacks(unknown: str) -> None:
    w = replace(quadruped(named_sensors("full", 12, 4, NOISE), samples=(60, 40)), terms=UNKNOWN[unknown])
    whole, _ = knowledge(w, w.logs)
    found = adds(w).sensors
    assert [s.bits for s in found] == sorted((s.bits for s in found), reverse=True)
    assert {s.name for s in found} == {*w.robot.joint_names, *(foot.frame for foot in FEET)}
    everything = {foot.frame: ALL for foot in FEET}
    for sensor in (next(s for s in found if s.kind == kind) for kind in ("joint torque", "contact wrench")):
        torques = [name for name in w.robot.joint_names if name != sensor.name]
        wrenches = {frame: names for frame, names in everything.items() if frame != sensor.name}
        rest, _ = knowledge(with_sensors(w, torques, wrenches), w.logs)
        assert sensor.bits == pytest.approx((whole - rest).bits, rel=1e-7)
        assert sensor.determined == pytest.approx((whole - rest).determined, rel=1e-7)


def test_half_as_many_independent_samples_tell_as_much_as_half_the_rows(three_logs: World) -> None:
    log = three_logs.logs[1]
    twice = [replace(log, oversampling=5.0), replace(log, source="again.npz", oversampling=5.0)]
    assert adds(replace(three_logs, logs=twice)).total.bits == pytest.approx(
        adds(replace(three_logs, logs=[log])).total.bits
    )


# ---------------------------------------------------------------------------------------------------------- the factors


@pytest.mark.parametrize("threads", [1, 2])
def test_parts_hold_every_sample_once_and_merge_into_the_whole(three_logs: World, threads: int) -> None:
    w, builder = three_logs, three_logs.builder
    parts = compress_parts(w.logs, builder, chunk=3, threads=threads)
    assert [part.source for part in parts] == sorted(part.source for part in parts)
    assert len({(part.source, part.state) for part in parts}) == len(parts)
    for log in w.logs:
        assert sum(part.samples for part in parts if part.source == log.source) == len(log)
    whole, R = gram(w), merge_factors((part.factor for part in parts), builder).triangle().numpy()[:-1, :-1]
    np.testing.assert_allclose(R.T @ R, whole, rtol=0.0, atol=1e-13 * np.abs(whole).max())


def test_rows_are_as_independent_as_those_of_the_logs_they_come_from(three_logs: World) -> None:
    w = three_logs
    logs = [replace(log, oversampling=kappa) for log, kappa in zip(w.logs, (1.0, 4.0, 2.0), strict=True)]
    parts = compress_parts(logs, w.builder)
    rows = [sum(p.factor.rows for p in parts if p.source == log.source) for log in logs]
    factor = merge_factors((part.factor for part in parts), w.builder)
    assert factor.oversampling == pytest.approx(sum(rows) / (rows[0] + rows[1] / 4.0 + rows[2] / 2.0))
    assert merge_factors([], w.builder).oversampling == 1.0


def test_tables_say_how_many_are_not_shown(three_logs: World) -> None:
    found = adds(three_logs)
    many = [SensorContribution(f"[red]joint {number}[/]", float(number), 1.0, "joint torque") for number in range(20)]
    text = table_text(contribution_table(replace(found, sensors=many)))
    assert "[red]joint 19[/]" in text
    assert "[red]joint 7[/]" not in text
    assert "and 8 more sensors" in text
    assert max(map(len, text.splitlines())) <= 100
