"""What the data determine, and what is lost without a log, a contact state or a sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from synthetic import SOLO12, UR5, Array, Oracle, load, make_log

from torchid.estimators import LeastSquares
from torchid.estimators.least_squares import VERDICTS
from torchid.identifiability.information import (
    Contributions,
    InformationGain,
    contributions,
    sensor_information,
)
from torchid.problem import ExtraTerms, LinearProblem, RowBuilder, Samples, assemble, bind_log, compress, compress_parts
from torchid.problem.compression import Part
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, chosen_sensors, named_sensors

NOISE = SensorNoise(0.5, 2.0, 0.2)


def problem_of(A: Array, b: Array, rows: int | None = None) -> LinearProblem:
    P = A.shape[1]
    return LinearProblem(A, b, 0.0, rows or len(b), np.zeros(P), np.ones(P), np.ones(P, dtype=bool))


# -------------------------------------------------------------------------------------------------- shares and verdicts


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


@pytest.mark.parametrize("unknown", UNKNOWN)
def test_sensors_are_ranked_by_what_a_fit_without_them_lacks(unknown: str) -> None:
    w = replace(quadruped(named_sensors("full", 12, 4, NOISE), samples=(30, 20)), terms=UNKNOWN[unknown])
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
