"""Synthetic posteriors, and whether their samples have the moments of long chains of another kind.

A robot whose parameters are up to 20 % off its URDF, with friction in half of its joints, is seen in random motions in
which a base that floats stands on one foot or more; joint torques have noise. The chains are hit-and-run chains
(`long_chain.py`). Needs the package example-robot-data (extra `[oracle]`).
"""

from __future__ import annotations

import sysconfig
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from long_chain import LongChain

from torchid.errors import TorchidWarning
from torchid.estimators import Conditions
from torchid.estimators.posterior import Posterior, whitened_rows
from torchid.identifiability.base_parameters import structural_samples
from torchid.parallel import one_thread
from torchid.parameters import FRICTION, Array, perturb_parameters
from torchid.problem import RowBuilder, compress, linear_problem
from torchid.robot import load_robot
from torchid.sensing import Contact, named_sensors

_FOLDER = Path(sysconfig.get_path("purelib")) / "cmeel.prefix/share/example-robot-data/robots"
ROBOTS = {
    "UR5": ("ur_description/urdf/ur5_robot.urdf", (), "flat"),
    "Solo12": ("solo_description/robots/solo12.urdf", ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), "point"),
    "G1": ("g1_description/urdf/g1_29dof_rev_1_0.urdf", ("left_ankle_roll_link", "right_ankle_roll_link"), "flat"),
}
_SAMPLES = 40_000


class Synthetic:
    """Random motions of a robot unlike its URDF; `true`, (L, 12), are its parameters."""

    def __init__(self, name: str, seed: int, error: float = 0.2, count: int = 200, rough: float = 0.5) -> None:
        """So many samples of each contact state; parameters off by `error`, a share `rough` of joints with friction."""
        urdf, feet, kind = ROBOTS[name]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)
            robot = load_robot(_FOLDER / urdf, fixed_base=not feet)
        contacts = [Contact(foot, kind) for foot in feet]
        all_but_one = [tuple(foot != other for other in feet) for foot in feet[:1] + feet[-1:]]
        builder = RowBuilder(robot, contacts, named_sensors("joints" if feet else "full", robot.n, len(feet)))
        samples = structural_samples(robot, contacts, [(True,) * len(feet), *all_but_one], count, seed)
        self.problem = linear_problem(compress(samples, builder), builder, robot)
        rng = np.random.default_rng(seed)
        true = perturb_parameters(robot.nominal, error, rng)
        true[:, FRICTION] = (rng.uniform(size=(len(true), 1)) < rough) * rng.uniform(0.0, 0.3, (len(true), 2))
        self.true = np.where(self.problem.free.reshape(true.shape), true, robot.nominal)
        self.conditions = Conditions(names=robot.body_names)

    def posterior(self, repetition: int) -> Posterior:
        """With rows of unit noise, which is new in each repetition."""
        problem, noise = self.problem, np.random.default_rng([repetition, 1]).normal(size=len(self.problem.A))
        noisy = replace(problem, b=problem.A @ self.true.flatten() + noise, residual=0.0)
        A, b = whitened_rows(noisy, 1.0, None)
        units, none = (problem.nominal, problem.scale, problem.free), np.zeros(0)
        return Posterior(A, np.zeros((len(A), 0)), b, *units, self.conditions, none, none)


def differences(one: Array, other: Array) -> dict[str, tuple[float, float]]:
    """Largest and rms difference of means, standard deviations and correlations of draws (N, n)."""
    deviation = other.std(axis=0)
    parts = {
        "mean": (one.mean(axis=0) - other.mean(axis=0)) / deviation,
        "deviation": one.std(axis=0) / deviation - 1.0,
        "correlation": np.corrcoef(one.T) - np.corrcoef(other.T),
    }
    return {name: (float(np.abs(x).max()), float(np.sqrt(np.mean(x**2)))) for name, x in parts.items()}


@one_thread()
def long_run(posterior: Posterior, prior_error: float, sweeps: int, chains: int) -> Array:
    """States of hit-and-run chains, (N, n), after a fifth of the sweeps as burn-in; a sweep has a step a variable."""
    conic, states = posterior.conic_problem(prior_error), []
    chain, steps = LongChain(conic, posterior.owners(), chains, seed=1), len(conic.linear)
    chain.run(sweeps // 5 * steps)
    chain.run(sweeps * steps, lambda x: states.append(x.astype(np.float32)), every=steps)
    return np.concatenate(states).astype(np.float64)
