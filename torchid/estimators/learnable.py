"""Learnable parameters: a raw vector, a preconditioner, and a map that may keep every body physically consistent."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.estimators.conditions import Conditions
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem

_LEAST_FRICTION = 0.01  # of its scale: initial friction if the URDF has none, since a softplus is never 0
_LEAST_EIGENVALUE = 1e-3  # above the margin: initial one of a body whose nominal eigenvalue is smaller


class LearnableParameters(nn.Module, ABC):
    """phi, (12 L,), and M terms, if the problem has any, as a function of `raw`, which is 0 at the nominal parameters.

    In the units of `raw` the compressed problem's Hessian is near the identity: phi is a function of
    `preconditioner @ raw`.
    """

    nominal: Tensor
    scale: Tensor
    free: Tensor
    terms: Tensor
    preconditioner: Tensor

    def __init__(self, problem: LinearProblem, size: int) -> None:
        """Start at the nominal parameters, without a preconditioner.

        Args:
            problem: its nominal parameters, scale and free parameters are used.
            size: of `raw`.
        """
        super().__init__()
        self.register_buffer("nominal", torch.from_numpy(problem.nominal.copy()))
        self.register_buffer("scale", torch.from_numpy(problem.scale.copy()))
        self.register_buffer("free", torch.from_numpy(problem.free.copy()))
        terms = np.zeros(0) if problem.terms is None else problem.terms.size
        self.register_buffer("terms", torch.from_numpy(terms.copy()), persistent=bool(len(terms)))
        self.register_buffer("preconditioner", torch.eye(size + len(terms), dtype=torch.float64))
        self.raw = nn.Parameter(torch.zeros(size + len(terms), dtype=torch.float64))

    @abstractmethod
    def constrained(self, u: Tensor) -> Tensor:
        """phi, (12 L,), at the first `size` entries of `preconditioner @ raw`."""

    def _with_terms(self, u: Tensor) -> Tensor:
        count = len(u) - len(self.terms)
        return torch.cat([self.constrained(u[:count]), self.terms * u[count:]])

    def forward(self) -> Tensor:
        """Phi and terms, (12 L + M,)."""
        return self._with_terms(self.preconditioner @ self.raw)

    def deviations(self, values: Tensor) -> Tensor:
        """What `forward` gives as deviations of the free parameters, and the terms, in units of their scale."""
        scaled = (values[: len(self.free)] - self.nominal) / self.scale
        return torch.cat([scaled[self.free], values[len(self.free) :] / self.terms])

    @one_thread()  # on a busy machine two took up to 1.4 s instead of 3 ms
    def precondition(self, problem: LinearProblem, ridge: float, damping: float) -> None:
        """Set the preconditioner to (H + damping I)^(-1/2).

        H is the Gauss-Newton Hessian at the nominal parameters of the mean squared residual plus ridge, in the
        variables of `constrained`. Without it first-order methods need some 1e10 steps at condition number 1e5. Without
        damping, steps along directions that the data hardly excite would be too long.
        """
        start = torch.zeros_like(self.raw)
        slopes = torch.autograd.functional.jacobian(self._with_terms, start, vectorize=True).cpu()
        data = torch.from_numpy(problem.A) @ slopes[: len(self.free)]
        if problem.terms is not None:
            data = torch.cat([data, torch.from_numpy(np.hstack([problem.terms.C, problem.terms.D])) @ slopes])
        prior = slopes[: len(self.free)] / self.scale.cpu()[:, None]
        hessian = 2.0 * (data.T @ data / max(problem.rows, 1) + ridge * prior.T @ prior)
        self.preconditioner.copy_(precondition_by(hessian, damping))

    def by_body(self, phi: Tensor) -> Tensor:
        """Parameters in units of their scale, (L, 12)."""
        return (phi[: len(self.free)] / self.scale).unflatten(0, (-1, PER_BODY))


def precondition_by(hessian: Tensor, damping: float) -> Tensor:
    """(H + damping I)^(-1/2) of a symmetric matrix, (n, n), whose negative eigenvalues are rounding."""
    values, vectors = torch.linalg.eigh(hessian)
    return vectors @ ((values.clamp_min(0.0) + damping).rsqrt()[:, None] * vectors.T)


class FreeParameters(LearnableParameters):
    """Any phi, an affine function of `raw`."""

    def __init__(self, problem: LinearProblem) -> None:
        super().__init__(problem, int(problem.free.sum()))

    def constrained(self, u: Tensor) -> Tensor:
        """Nominal parameters (P,) plus `u`, of the free ones (F,), in units of the scale."""
        return self.nominal.masked_scatter(self.free, self.nominal[self.free] + self.scale[self.free] * u)


class LogCholeskyParameters(LearnableParameters):
    """Only physically consistent phi: scaled pseudo-inertias above a margin, positive friction.

    J = margin I + R R^T with R = R_0 M, where R_0 is the Cholesky factor at the nominal parameters and M is lower
    triangular with the logarithms of its diagonal and its other entries as coordinates, so that M is the identity where
    they are 0. Friction is a softplus.

    Source: Rucker, Wensing, "Smooth parameterization of rigid-body inertia", RA-L 2022.
    """

    root: Tensor
    friction_start: Tensor

    def __init__(self, problem: LinearProblem, margin: float = Conditions.margin) -> None:
        """Start at the nominal parameters, with eigenvalues raised above the margin.

        Args:
            problem: the problem.
            margin: least eigenvalue of every free body's scaled pseudo-inertia.

        Raises:
            ValueError: inertial parameters that are not free body by body.
        """
        free = problem.free.reshape(-1, PER_BODY)
        bodies = problem.free_bodies()
        super().__init__(problem, parameters.INERTIAL.stop * len(bodies) + int(free[:, parameters.FRICTION].sum()))
        self.margin = margin
        scaled = (problem.nominal / problem.scale).reshape(-1, PER_BODY)
        values, vectors = np.linalg.eigh(parameters.pseudo_inertia(scaled[bodies]))
        above = np.maximum(values - margin, _LEAST_EIGENVALUE)
        nominal = torch.from_numpy((vectors * above[:, None]) @ vectors.transpose(0, 2, 1))
        self.register_buffer("root", torch.linalg.cholesky(nominal))
        self.register_buffer(
            "_from_pseudo", torch.from_numpy(np.linalg.pinv(parameters.PSEUDO_BASIS.reshape(-1, 16).T))
        )
        rows, columns = np.tril_indices(4)
        self.register_buffer("_rows", torch.from_numpy(rows))
        self.register_buffer("_columns", torch.from_numpy(columns))
        moving = np.zeros(free.shape, dtype=bool)
        moving[bodies, parameters.INERTIAL] = True
        self.register_buffer("_inertial", torch.from_numpy(moving.ravel()))
        self.register_buffer("_frictional", torch.from_numpy((free & ~moving).ravel()))
        start = np.maximum(scaled.ravel()[(free & ~moving).ravel()], _LEAST_FRICTION)
        self.register_buffer("friction_start", torch.from_numpy(start + np.log(-np.expm1(-start))))

    def constrained(self, u: Tensor) -> Tensor:
        """Parameters of the bodies with log-Cholesky coordinates `u`, ten by body, then friction."""
        bodies = len(self.root)
        coordinates = u[: parameters.INERTIAL.stop * bodies].reshape(bodies, parameters.INERTIAL.stop)
        rows, columns = self.get_buffer("_rows"), self.get_buffer("_columns")
        entries = torch.where(rows == columns, coordinates.exp(), coordinates)
        M = entries.new_zeros(bodies, 4, 4)
        M[:, rows, columns] = entries
        R = self.root @ M
        J = R @ R.mT + self.margin * torch.eye(4, dtype=u.dtype, device=u.device)
        ten = J.flatten(1) @ self.get_buffer("_from_pseudo").T
        friction = nn.functional.softplus(u[parameters.INERTIAL.stop * bodies :] + self.friction_start)
        inertial, frictional = self.get_buffer("_inertial"), self.get_buffer("_frictional")
        phi = self.nominal.masked_scatter(inertial, ten.flatten() * self.scale[inertial])
        return phi.masked_scatter(frictional, friction * self.scale[frictional])
