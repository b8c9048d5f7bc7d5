"""The linear problem in the parameters of all bodies that a triangular factor poses."""

from __future__ import annotations

import numpy as np

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.chunks import one_thread
from torchid.problem.linear import PRIOR_DEVIATION, LinearProblem, TriangularFactor, parameter_scale
from torchid.problem.noise_gram import ColumnPrior, corrected_triangle
from torchid.problem.rows import RowBuilder
from torchid.robot import Robot


@one_thread()
def linear_problem(factor: TriangularFactor, builder: RowBuilder, robot: Robot, friction: bool = True) -> LinearProblem:
    """Pose the linear problem in all 12 L parameters of the bodies from a factor that `compress` made.

    Raises:
        ValueError: the builder has extra parameters; `assemble` eliminates them.
    """
    if builder.extras:
        raise ValueError("builder: found extra terms; accepted: one without, or torchid.assemble")
    own = corrected_triangle(factor, column_prior(builder, robot, friction))
    return problem_from_triangle(own.R, factor.rows, factor.oversampling, builder, robot, friction, own.held)


def column_prior(builder: RowBuilder, robot: Robot, friction: bool = True) -> ColumnPrior:
    """The nominal parameters in the builder's columns, and deviations within their scale of those that are free."""
    columns, nominal = builder.columns.parameter_map, robot.nominal.flatten()
    scale = np.where(free_parameters(robot, friction), parameter_scale(robot.nominal).flatten(), 0.0)
    return ColumnPrior(columns @ nominal, columns * (PRIOR_DEVIATION * scale))


def problem_from_triangle(
    R: Array, rows: int, oversampling: float, builder: RowBuilder, robot: Robot, friction: bool, held: Array | None
) -> LinearProblem:
    """The problem in all 12 L parameters from a triangle in the regrouped columns, right-hand side last.

    Args:
        R: (M, columns + 1).
        rows: that went into it.
        oversampling: of them.
        builder: of the rows.
        robot: the robot.
        friction: whether friction is free.
        held: (columns, Q), as `CorrectedTriangle` has it.
    """
    count = builder.columns.count
    return LinearProblem(
        A=R[:count, :-1] @ builder.columns.parameter_map,
        b=R[:count, -1],
        residual=float(np.square(R[count:, -1]).sum()),
        rows=rows,
        nominal=robot.nominal.flatten(),
        scale=parameter_scale(robot.nominal).flatten(),
        free=free_parameters(robot, friction),
        oversampling=oversampling,
        held=None if held is None else R[:count, :-1] @ held,
    )


def free_parameters(robot: Robot, friction: bool = True) -> np.ndarray:
    """Parameters that can be fitted, (12 L,) bool.

    All but inertial parameters of massless bodies, friction of welds, and any friction if not `friction`.
    """
    free = np.ones(robot.nominal.shape, dtype=bool)
    free[[body.massless for body in robot.bodies], parameters.INERTIAL] = False
    still = [body.joint is None or body.joint.kind == "fixed" for body in robot.bodies]
    free[still if friction else slice(None), parameters.FRICTION] = False
    return free.flatten()
