"""The ten inertial numbers: order, frames, pseudo-inertia, perturbation."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic import PINOCCHIO_ORDER, Array, transform

from torchid import parameters

finite = st.floats(-2.0, 2.0, allow_nan=False)
vectors = st.tuples(finite, finite, finite).map(np.array)
rotations = vectors.map(lambda x: Rotation.from_rotvec(1.5 * x).as_matrix())
poses = st.builds(transform, rotations, vectors)
positive = st.floats(0.05, 5.0)


@st.composite
def bodies(draw: st.DrawFn) -> tuple[float, Array, Array]:
    """Mass, centre of mass, and an inertia about it with three different principal values in turned axes."""
    second_moments = np.array(draw(st.tuples(positive, positive, positive)))
    R = draw(rotations)
    return draw(positive), draw(vectors), R @ np.diag(second_moments.sum() - second_moments) @ R.T


def test_the_parameters_are_in_the_papers_order() -> None:
    assert " ".join(parameters.PARAMETERS) == "m mcx mcy mcz Ixx Ixy Ixz Iyy Iyz Izz fc fv"
    assert parameters.PER_BODY == 12
    phi = np.arange(10.0)
    np.testing.assert_array_equal(parameters.inertia_matrix(phi), [[4, 5, 6], [5, 7, 8], [6, 8, 9]])
    assert len(parameters.PARAMETER_UNITS) == 12


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies())
def test_parameters_are_pinocchios_in_its_order(body: tuple[float, Array, Array]) -> None:
    expected = pin.Inertia(*body).toDynamicParameters()
    phi = parameters.inertial_vector(*body)
    np.testing.assert_allclose(phi[PINOCCHIO_ORDER], expected, rtol=0.0, atol=1e-13)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies())
def test_mass_centre_and_inertia_come_back(body: tuple[float, Array, Array]) -> None:
    mass, com, inertia = parameters.mass_com_inertia(parameters.inertial_vector(*body))
    assert mass == body[0]
    np.testing.assert_allclose(com, body[1], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(inertia, body[2], rtol=0.0, atol=1e-13)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(bodies(), poses)
def test_a_body_seen_from_another_frame_is_pinocchios(body: tuple[float, Array, Array], T: Array) -> None:
    expected = pin.SE3(T).act(pin.Inertia(*body)).toDynamicParameters()
    phi = parameters.change_of_frame(T) @ parameters.inertial_vector(*body)
    np.testing.assert_allclose(phi[PINOCCHIO_ORDER], expected, rtol=0.0, atol=1e-12)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.tuples(positive, vectors), min_size=1, max_size=6))
def test_the_pseudo_inertia_is_the_second_moment_of_the_mass_points(points: list[tuple[float, Array]]) -> None:
    phi = sum(parameters.inertial_vector(mass, place, np.zeros((3, 3))) for mass, place in points)
    moments = sum(mass * np.outer([*place, 1.0], [*place, 1.0]) for mass, place in points)
    np.testing.assert_allclose(parameters.pseudo_inertia(phi), moments, rtol=0.0, atol=1e-13)
    assert parameters.consistency_margin(phi) >= -1e-14


# -------------------------------------------------------------------------------------------------------- perturbation


def many(count: int = 400) -> Array:
    """Parameters (count, 12) of real bodies with friction."""
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(count):
        moments, R = rng.uniform(0.05, 5.0, 3), Rotation.random(random_state=rng).as_matrix()
        inertia = R @ np.diag(moments.sum() - moments) @ R.T
        body = parameters.inertial_vector(rng.uniform(0.1, 9.0), rng.uniform(-1.0, 1.0, 3), inertia)
        rows.append(np.concatenate([body, rng.uniform(0.0, 1.0, 2)]))
    return np.array(rows)


@pytest.mark.parametrize("error", [0.0, 0.2, 0.99])
def test_a_perturbed_body_differs_by_factors_within_the_bounds(error: float) -> None:
    true = many()
    factors = []
    for phi, other in zip(true, parameters.perturb_parameters(true, error, np.random.default_rng(0)), strict=True):
        (mass, com, inertia), (m, c, I) = (parameters.mass_com_inertia(x) for x in (phi, other))  # noqa: E741
        scale = np.trace(I) / np.trace(inertia)
        np.testing.assert_allclose(I, scale * inertia, rtol=0.0, atol=1e-9 * np.trace(inertia))
        factors.append([m / mass, *(c / com), scale])
    found = np.array(factors)
    assert np.abs(found - 1.0).max() <= error + 1e-9
    if error:
        assert (np.ptp(found, axis=0) > 1.9 * error).all()  # both ends are reached
        together = np.corrcoef(found.T) - np.eye(5)
        assert np.abs(together).max() < 0.25  # independent of each other: 5 standard deviations of 400 draws


def test_a_plate_stays_a_plate_and_no_body_becomes_impossible() -> None:
    plate = np.pad(parameters.inertial_vector(2.0, np.zeros(3), np.diag([1.0, 2.0, 3.0])), (0, 2))[None]
    other = parameters.perturb_parameters(plate, 0.5, np.random.default_rng(0))
    assert abs(parameters.consistency_margin(other)[0]) < 1e-12
    assert (other[0, parameters.FIRST_MOMENT] == 0.0).all()
