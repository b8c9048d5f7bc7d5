"""Projection of a batch in one shape: bases V_x of m columns; those that a sample's contacts take away are zero.

A compiled kernel makes bases and products in one pass over K; singular value decompositions make those of samples that
may have lost rank, and all where there is no kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid import kernels

_library = torch.library.Library("torchid", "FRAGMENT")


@dataclass(frozen=True)
class Sensors:
    """What is measured, as tensors on the device of the samples, in their precision.

    Attributes:
        kept: (m,) int64, rows of the base and of measured torques.
        unmeasured, measured: int64, rows of J_C.
        row_std, wrench_std: (m,) and (measured,), noise; ones and () if rows are not to be whitened.
        base_rows: 6, or 0 for a fixed base.
        floor, tolerance: singular values that count as zero: the larger of a number and a share of the largest.
    """

    kept: Tensor
    unmeasured: Tensor
    measured: Tensor
    row_std: Tensor
    wrench_std: Tensor
    base_rows: int
    floor: float
    tolerance: float

    @property
    def constants(self) -> list[Tensor]:
        """All tensors, in order."""
        return [self.kept, self.unmeasured, self.measured, self.row_std, self.wrench_std]

    def basis(self, J: Tensor, active: Tensor) -> Tensor:
        """Orthonormal bases of the null spaces of unmeasured forces, (..., m, m), by singular values; no gradient."""
        A = self.blocked(J, active).detach()
        is_number = A.isfinite().all(-1).all(-1)[..., None, None]
        _, values, Vh = torch.linalg.svd(A.nan_to_num(0.0, 0.0, 0.0), full_matrices=True)
        values = torch.nn.functional.pad(values, (0, A.shape[-1] - values.shape[-1]))
        negligible = (self.tolerance * values[..., :1]).clamp_min(self.floor)
        return torch.where(is_number, Vh.mT * (values <= negligible)[..., None, :], torch.nan)

    def blocked(self, J: Tensor, active: Tensor) -> Tensor:
        """Rows A of unmeasured forces that act, (..., k, m), in units of the noise; zero where they do not."""
        rows = J[..., self.unmeasured, :][..., self.kept]
        return torch.where(active[..., self.unmeasured, None], rows, 0.0) / self.row_std

    def whitened(self, basis: Tensor, J: Tensor, active: Tensor) -> Tensor:
        """V_x, (..., n_rows, m), as a differentiable function of J, from bases at its value.

        The projection onto the null space of A does not change them; to first order dV = -A^+ dA V (Golub, Pereyra
        1973).
        """
        A = self.blocked(J, active).nan_to_num(0.0, 0.0, 0.0)  # where it is no number, nor is the basis
        inverse = torch.linalg.pinv(A, atol=self.floor, rtol=self.tolerance)
        basis = basis - inverse @ (A @ basis)
        covariance = basis.mT @ basis + torch.diag_embed((basis == 0.0).all(-2).to(basis.dtype))
        W = basis / self.row_std[:, None]
        if len(self.wrench_std):
            acting = torch.where(active[..., self.measured, None], J[..., self.measured, :], 0.0)
            through = (acting[..., self.kept] @ W) * self.wrench_std[:, None]
            covariance = covariance + through.mT @ through
        W = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(covariance).L, W.mT, upper=False).mT
        V = W.new_zeros(*W.shape[:-2], J.shape[-1], W.shape[-1])
        return V.index_copy(-2, self.kept, W)

    def force(self, J: Tensor, active: Tensor, torque: Tensor, wrench: Tensor) -> Tensor:
        """Generalized force of all that is measured, (..., m)."""
        acts = active[..., self.measured]
        pushes = torch.where(acts, wrench[..., self.measured], 0.0)
        rows = torch.where(acts[..., None], J[..., self.measured, :], 0.0)[..., self.kept]
        joints = self.kept[self.base_rows :] - self.base_rows
        return (rows.mT @ pushes[..., None])[..., 0] + torch.nn.functional.pad(torque[..., joints], (self.base_rows, 0))

    def products(
        self, V: Tensor, J: Tensor, active: Tensor, K: Tensor, torque: Tensor, wrench: Tensor
    ) -> tuple[Tensor, Tensor]:
        """V_x^T K and V_x^T f."""
        rows = V[..., self.kept, :].mT
        return rows @ K[..., self.kept, :], (rows @ self.force(J, active, torque, wrench)[..., None])[..., 0]

    def project(
        self, J: Tensor, active: Tensor, K: Tensor, torque: Tensor, wrench: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """V_x, V_x^T K and V_x^T f by torch's operators, differentiable."""
        V = self.whitened(self.basis(J, active), J, active)
        return V, *self.products(V, J, active, K, torque, wrench)


def _write(
    J: Tensor,
    active: Tensor,
    K: Tensor,
    torque: Tensor,
    wrench: Tensor,
    constants: list[Tensor],
    base_rows: int,
    floor: float,
    tolerance: float,
    out: list[Tensor],
) -> None:
    (kept, unmeasured, measured, row_std, wrench_std) = constants
    sensors = Sensors(kept, unmeasured, measured, row_std, wrench_std, base_rows, floor, tolerance)
    suspect = active.new_empty(len(J))
    J, active, torque, wrench = (x.contiguous() for x in (J, active, torque, wrench))
    out[0].zero_()
    std: kernels.Word = wrench_std if len(wrench_std) else 0
    inputs: list[kernels.Word] = [J, row_std, std, torque, wrench, K.data_ptr(), active]
    (k, m) = (len(unmeasured), len(kept))
    sizes = len(J), J.shape[2], base_rows, J.shape[1], m, k, len(measured), K.shape[2], *K.stride()
    results: list[kernels.Word] = [np.array([floor, tolerance]), *out, suspect]
    if k <= m:
        name = f"torchid_projection_{str(K.dtype).removeprefix('torch.')}"
        kernels.call(name, (*inputs, kept, unmeasured, measured, *sizes, *results), torch.get_num_threads())
    else:
        suspect.fill_(True)
    doubtful = torch.nonzero(suspect)[:, 0]
    if len(doubtful):
        some = (x[doubtful] for x in (J, active, K, torque, wrench))
        for x, made in zip(out, sensors.project(*some), strict=True):
            x[doubtful] = made


def _project(*arguments: Any) -> list[Tensor]:
    out = _imagine(*arguments)
    _write(*[*arguments, out])
    return out


def _imagine(
    J: Tensor, active: Tensor, K: Tensor, torque: Tensor, wrench: Tensor, constants: list[Tensor], *_: float
) -> list[Tensor]:
    samples, m = J.shape[0], constants[0].shape[0]
    return [K.new_empty(shape) for shape in ((samples, J.shape[2], m), (samples, m, K.shape[2]), (samples, m))]


def _mapped(info: Any, in_dims: tuple[Any, ...], *arguments: Any) -> tuple[list[Tensor], list[int]]:
    """What is mapped over becomes samples of one batch."""
    size = info.batch_size
    batches = [
        x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)
        for x, dim in zip(arguments[:5], in_dims, strict=False)
    ]
    out = project(*(x.flatten(0, 1) for x in batches), *arguments[5:])
    return [x.unflatten(0, (size, -1)) for x in out], [0, 0, 0]


_ARGUMENTS = (
    "Tensor J, Tensor active, Tensor K, Tensor torque, Tensor wrench, Tensor[] constants, int base_rows, float floor,"
    " float tolerance"
)
_library.define(f"projection({_ARGUMENTS}) -> Tensor[]")
_library.define(f"write_projection({_ARGUMENTS}, Tensor(a!)[] out) -> ()")
_library.impl("projection", _project, "CPU")
_library.impl("write_projection", _write, "CPU")
torch.library.register_fake("torchid::projection", _imagine, lib=_library)
torch.library.register_fake("torchid::write_projection", lambda *arguments: None, lib=_library)
torch.library.register_vmap("torchid::projection", _mapped, lib=_library)
project: Callable[..., list[Tensor]] = torch.ops.torchid.projection.default
"""V_x, V_x^T K and V_x^T f of samples (B, ...), as `Sensors.project` makes them, without gradients."""
write_projection: Callable[..., None] = torch.ops.torchid.write_projection.default
"""The same to tensors that an earlier call has made."""
