"""Whether forces show friction that a fit has left at its nominal values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from torchid.estimators.least_squares import residual_std
from torchid.parameters import FRICTION, INERTIAL, PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.problem.chunks import one_thread
from torchid.robot import Robot
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE, is_significant

_LEVEL = 1e-3  # share of fits without such friction that show some
_MUCH = 2.0  # times the squares that it would explain of noise, at least, which is not known to the last percent
_UNITS = {"prismatic": ("N", "N s/m")}
_ROTARY = ("N m", "N m s/rad")
_NAMED = 2


@dataclass(frozen=True)
class UnfittedFriction:
    """What friction that was not fitted would explain of the residuals.

    Attributes:
        joints: that it was not fitted of, those whose forces show it most clearly first.
        values: friction beyond the nominal one, (len(joints), 2), Coulomb and viscous.
        units: of both, by joint.
        ratio: squares that it explains over those that it would explain of noise; about 1 without friction.
        combinations: of its parameters that the rows tell from all that was fitted.
    """

    joints: tuple[str, ...]
    values: Array
    units: tuple[tuple[str, str], ...]
    ratio: float
    combinations: int

    @property
    def significant(self) -> bool:
        """Whether noise would explain as much in fewer than one of a thousand fits.

        Source: the F test of linear hypotheses, of many degrees of freedom of noise.
        """
        if not self.combinations:
            return False
        return self.ratio > max(_MUCH, float(chdtri(self.combinations, _LEVEL)) / self.combinations)

    def __str__(self) -> str:
        """How much it explains, and of which joints most."""
        shown = [
            f"{joint} {coulomb:.2g} {units[0]} and {viscous:.2g} {units[1]}"
            for joint, (coulomb, viscous), units in zip(self.joints, self.values, self.units, strict=True)
        ]
        named = ", ".join(shown[:_NAMED])
        return f"friction, which is not fitted, explains {self.ratio:.2g} times as much as it would of noise ({named})"


@one_thread()
def unfitted_friction(problem: LinearProblem, robot: Robot) -> UnfittedFriction | None:
    """The friction that a fit of a problem has left nominal and its rows show; None where no row shows any.

    Friction of joints whose bodies are frozen is not meant to be found.

    Args:
        problem: of a fit.
        robot: with the joints.
    """
    joints = {body: part.joint for body, part in enumerate(robot.bodies) if part.joint is not None}
    free, A = problem.free.reshape(-1, PER_BODY), problem.A.reshape(len(problem.A), -1, PER_BODY)[:, :, FRICTION]
    bodies = [body for body in joints if free[body, INERTIAL].any() and not free[body, FRICTION].any()]
    bodies = [body for body in bodies if A[:, body].any(axis=0).all()]
    if not bodies:
        return None
    columns = A[:, bodies].reshape(len(A), -1)
    size = np.linalg.norm(columns, axis=0)
    U, values, _ = np.linalg.svd(problem.A[:, problem.free] * problem.scale[problem.free], full_matrices=False)
    U = U[:, is_significant(values, RANK_TOLERANCE)]
    rows = np.column_stack([columns / size, problem.b - problem.A @ problem.nominal])
    rows -= U @ (U.T @ rows)
    V, values, Wh = np.linalg.svd(rows[:, :-1], full_matrices=False)
    kept = values > UNOBSERVABLE_SHARE
    explained, rank = V[:, kept].T @ rows[:, -1], int(kept.sum())
    cost = float(rows[:, -1] @ rows[:, -1] - explained @ explained) + problem.residual
    noise = problem.oversampling * residual_std(cost, problem.rows, U.shape[1] + rank, problem.oversampling) ** 2
    inverse = Wh[kept].T / values[kept]
    found, deviation = inverse @ explained, np.maximum(np.linalg.norm(inverse, axis=1), np.finfo(float).tiny)
    order = np.argsort(-np.square(found / deviation).reshape(-1, 2).sum(axis=1))
    shown = [joints[bodies[index]] for index in order]
    return UnfittedFriction(
        joints=tuple(joint.name for joint in shown),
        values=(found / size).reshape(-1, 2)[order],
        units=tuple(_UNITS.get(joint.kind, _ROTARY) for joint in shown),
        ratio=float(explained @ explained) / max(rank * noise, np.finfo(float).tiny),
        combinations=rank,
    )
