"""Parameters that are fitted between two detections: by what data and URDF make most probable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from legged.gait import Reference
from legged.robots import FRICTION_WIDTH, QUADRUPED, TrueRobot
from legged.simulate import simulated
from motions import value

from torchid.logs.preprocess import near_contact_changes
from torchid.parameters import COULOMB, PER_BODY
from torchid.problem import LinearProblem
from torchid.problem.contact_detection import fitted_parameters, most_probable, prepare
from torchid.problem.extras import ExtraTerms
from torchid.problem.rows import RowBuilder
from torchid.sensing import named_sensors


def problem(A: np.ndarray, b: np.ndarray, free: np.ndarray) -> LinearProblem:
    return LinearProblem(A, b, 0.0, len(b), np.full(A.shape[1], 2.0), np.ones(A.shape[1]), free)


def test_exact_data_decide_and_what_no_row_depends_on_stays_nominal() -> None:
    rng = np.random.default_rng(0)
    A, truth, free = rng.standard_normal((40, 6)), 2.0 + 0.3 * rng.standard_normal(6), np.arange(6) != 1
    truth[[1, 4]], A[:, 4] = 2.0, 0.0
    np.testing.assert_allclose(most_probable(problem(A, A @ truth, free)), truth, atol=1e-6)


def test_the_prior_has_the_share_that_noise_leaves_it() -> None:
    """One row with noise that is as large as the prior says of the parameter: half of it."""
    A, b = np.ones((2, 1)), np.array([2.0 + 2.0 / 3.0, 2.0 - 2.0 / 3.0]) + 0.5
    rows = problem(A, b, np.ones(1, dtype=bool))
    found = most_probable(rows)[0] - 2.0
    variance = np.mean((b - 2.0 - found) ** 2)
    assert abs(found - 0.5 * 2.0 / (2.0 + 3.0 * variance)) < 1e-2


def test_the_mass_of_a_walker_follows_from_its_torques_and_the_contacts_that_stand() -> None:
    """The URDF is 1.5 kg off, and no contact force is measured: in the air legs weigh what their joints carry."""
    true = TrueRobot.unlike_its_urdf(QUADRUPED, 0)
    exact = simulated(true, Reference(true, 5.0, seed=0), 5.0)
    contacts = QUADRUPED.contacts()
    found = prepare(exact.log, true.robot, contacts, np.inf)
    at = np.searchsorted(exact.log.time, found.log.time - 1e-9)
    samples = replace(found.samples, active=torch.from_numpy(value(exact.log.contact_active)[at]))
    away = ~near_contact_changes(exact.log, found.log.time, 0.05)
    sensors = named_sensors("joints", true.robot.n, len(contacts))
    builder = RowBuilder(true.robot, contacts, sensors, ExtraTerms(armature=True, sign_width=FRICTION_WIDTH))
    phi, armature = fitted_parameters(samples[torch.from_numpy(np.flatnonzero(away))], builder, true.robot)
    np.testing.assert_allclose(armature, true.armature, rtol=0.02)
    np.testing.assert_allclose(phi[1:, COULOMB], true.phi.reshape(-1, PER_BODY)[1:, COULOMB], rtol=0.02)
    masses = [float(x[:, 0].sum()) for x in (phi, true.phi, true.robot.nominal)]
    assert abs(masses[0] - masses[1]) < 0.05 * abs(masses[2] - masses[1])
