"""Projection with V_x, a basis of the null space of the unmeasured forces (Mistry et al. 2009, eq. 7 to 9)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, overload

import torch
from torch import Tensor, nn

from torchid.kernels import compiled
from torchid.reprs import short_repr
from torchid.rounding import BASE_RANK_TOLERANCE, KINEMATIC_TOLERANCE, relative_tolerance
from torchid.sensing.padded import Sensors, project, write_projection

_ROUNDINGS = 100.0  # rounding error of a Jacobian entry, in units of rounding of a unit term
_SUSPECT = 1e3  # below this many tolerances, the QR path hands the sample to an SVD


@dataclass(frozen=True)
class ProjectedGroup:
    """Projected samples that share a contact state and a rank r, or all of a batch, padded with zeros.

    Attributes:
        index: (B',), numbers of the samples in the batch; with leading dimensions `...` where padded.
        active: (k,) bool, rows of J_C in contact; (..., k) where padded.
        V: (B', n_rows, r), V_x; orthonormal, or whitened if noise was given; (..., n_rows, m) where padded.
        K: (B', r, P), V_x^T K; (..., m, P) where padded.
        f: (B', r), V_x^T f; (..., m) where padded.
        base_rows: 6, or 0 for a fixed base.
    """

    index: Tensor
    active: Tensor
    V: Tensor
    K: Tensor
    f: Tensor
    base_rows: int

    __repr__ = short_repr

    def by_rank(self) -> list[ProjectedGroup]:
        """Groups of a contact state and a rank each, of a padded one with samples (B,)."""
        kept = self.V.any(-2)
        columns = kept.to(torch.int8).argsort(dim=1, descending=True, stable=True)
        kinds = torch.cat([self.active, kept.sum(1, keepdim=True)], dim=1)
        states, which = torch.unique(kinds, dim=0, return_inverse=True)
        groups = []
        for number, (*_, rank) in enumerate(states.tolist()):
            index = torch.nonzero(which == number)[:, 0]
            at = (index[:, None], columns[index, :rank])
            V = self.V.mT[at].mT
            groups.append(ProjectedGroup(index, self.active[index[0]], V, self.K[at], self.f[at], self.base_rows))
        return groups

    @property
    def base_rank(self) -> Tensor:
        """rank(S_b V_x), (B',); 6 if the base is observable, 0 for a fixed base."""
        V = self.V.detach()
        if not self.base_rows:
            return torch.zeros_like(V[..., 0, 0], dtype=torch.int64)
        U = torch.linalg.svd(V, full_matrices=False).U
        in_basis = torch.arange(U.shape[-1], device=U.device) < V.any(-2).sum(-1, keepdim=True)
        return base_rank(base_singular_values(U * in_basis[..., None, :]))


class Projection(nn.Module):
    """Removes unmeasured forces from the dynamics: computes V_x, V_x^T K and V_x^T f for one sensor set.

    Unmeasured forces enter the dynamics through `A_x = [S_x; J_x]`: unit rows for unmeasured joint torques, rows of the
    contact Jacobian for unmeasured wrench components of active contacts. `V_x` spans the null space of `A_x`. The
    projected equation `V_x^T K phi = V_x^T A_m^T [tau_m; lambda_m]` contains measured forces only.

    Source: Mistry, Schaal, Yamane 2009, eq. 7 to 9.

    Gradients flow to all arguments, also through `V_x`. The basis `V_x` is arbitrary, so only losses that do not depend
    on its choice (such as the sum of squared projected forces) have a meaningful gradient. There is no derivative where
    an active contact loses rank (a straight knee).

    K may be any matrix with the rows of the dynamics. Fits use the faster `torchid.RowBuilder` with the same null
    spaces (`tests/problem/test_rows_two_ways.py` compares both).
    """

    kept: Tensor
    rows: Tensor
    unmeasured: Tensor
    measured: Tensor

    def __init__(
        self,
        torque_measured: Sequence[bool] | Tensor,
        wrench_measured: Sequence[bool] | Tensor,
        base_rows: int = 6,
        torque_noise: float | Tensor | None = None,
        wrench_noise: float | Tensor | None = None,
        base_noise: float | Tensor | None = None,
    ) -> None:
        """Set the sensors.

        Args:
            torque_measured: (n,) bool.
            wrench_measured: (k,) bool, in the order of the rows of J_C.
            base_rows: 6, or 0 for a fixed base.
            torque_noise: standard deviation [N m], scalar or (n,). If all three are given, rows are whitened.
            wrench_noise: standard deviation [N or N m], scalar or (k,).
            base_noise: standard deviation of the base rows without sensor noise [N or N m], scalar or (6,).

        Raises:
            ValueError: a mask is not 1-D, only some of the noises are given, or one is not positive.
        """
        super().__init__()
        noises = (torque_noise, wrench_noise, base_noise)
        if any(x is None for x in noises) and any(x is not None for x in noises):
            raise ValueError("torque_noise, wrench_noise, base_noise: found only some; accepted: all three or none")
        torque = torch.as_tensor(torque_measured, dtype=torch.bool)
        wrench = torch.as_tensor(wrench_measured, dtype=torch.bool, device=torque.device)
        for name, mask in (("torque_measured", torque), ("wrench_measured", wrench)):
            if mask.ndim != 1:
                raise ValueError(f"{name}: found shape {tuple(mask.shape)}; accepted: 1-D, one bool per row")
        self.base_rows = base_rows
        self._compiles = compiled() is not None
        self.register_buffer("torque_measured", torque, persistent=False)
        self.register_buffer("wrench_measured", wrench, persistent=False)
        self.register_buffer("kept", torch.cat([torque.new_ones(base_rows), torque]), persistent=False)
        for name, mask in (("rows", self.kept), ("unmeasured", ~wrench), ("measured", wrench)):
            self.register_buffer(name, torch.nonzero(mask)[:, 0], persistent=False)
        self._size = 1.0  # of the terms that are summed in an entry of the blocked rows
        self._whiten = torque_noise is not None
        if self._whiten:
            torque_std, wrench_std, base_std = (
                torch.as_tensor(x, dtype=torch.float64, device=torque.device) for x in noises
            )
            rows = torch.cat([base_std.expand(base_rows), torque_std.expand(len(torque))])
            wrench_std = wrench_std.expand(len(self.get_buffer("wrench_measured")))
            if not bool((rows > 0.0).all()) or not bool((wrench_std > 0.0).all()):
                raise ValueError("torque_noise, wrench_noise, base_noise: found 0 or less; accepted: positive numbers")
            self._size = float(torch.linalg.vector_norm(1.0 / rows[self.kept]))
            self.register_buffer("row_std", rows, persistent=False)
            self.register_buffer("wrench_std", wrench_std, persistent=False)

    def extra_repr(self) -> str:
        """What `repr` says."""
        torque = self.get_buffer("torque_measured")
        wrench = self.get_buffer("wrench_measured")
        return f"measured: {torque.sum()} of {len(torque)} torques, {wrench.sum()} of {len(wrench)} contact components"

    @overload
    def forward(
        self, J_C: Tensor, active: Tensor, K: Tensor, torque: Tensor, wrench: Tensor, pad: Literal[False] = False
    ) -> list[ProjectedGroup]: ...

    @overload
    def forward(
        self,
        J_C: Tensor,
        active: Tensor,
        K: Tensor,
        torque: Tensor,
        wrench: Tensor,
        pad: Literal[True],
        out: ProjectedGroup | None = None,
    ) -> ProjectedGroup: ...

    def forward(
        self,
        J_C: Tensor,
        active: Tensor,
        K: Tensor,
        torque: Tensor,
        wrench: Tensor,
        pad: bool = False,
        out: ProjectedGroup | None = None,
    ) -> list[ProjectedGroup] | ProjectedGroup:
        """Project a batch.

        Args:
            J_C: (B, k, n_rows), contact Jacobian with the rows of all contacts, active or not.
            active: (B, k) bool, rows whose contact touches the ground. The wrench of other rows counts as zero.
            K: (B, n_rows, P), or any other matrix with the rows of the dynamics.
            torque: (B, n) [N m]; unmeasured values are ignored.
            wrench: (B, k), in the order of the rows of J_C [N, N m]; unmeasured or inactive values are ignored.
            pad: whether to return one group of one shape, whatever the contact states. It has as many rows as there are
                base rows and measured torques. Columns of V_x that a sample's contacts take away are zero, and so are
                these rows of K and f. The arguments may then have any number of leading dimensions in place of B, or
                none, and `torch.func.vmap` may map over them.
            out: with `pad`, what an earlier call returned for as many samples; its tensors are written again, which
                saves the time to allocate memory.

        Returns:
            One group per contact state and rank; every sample is in exactly one group. With `pad` one for all samples.

        Raises:
            TypeError: an argument is not a tensor, `active` is not bool, or another dtype differs from that of `K`.
            ValueError: a shape is wrong.
        """
        samples = self._require_batch({"J_C": J_C, "active": active, "K": K, "torque": torque, "wrench": wrench}, pad)
        arguments = (J_C, active, K, torque, wrench)
        differentiable = torch.is_grad_enabled() and any(x.requires_grad for x in arguments)
        if pad:
            return self._padded(samples, out, differentiable, *arguments)
        if self._runs_compiled(K):
            return self._padded(samples, None, differentiable, *arguments).by_rank()
        groups: list[ProjectedGroup] = []
        if active.shape[1]:
            states, which = torch.unique(active, dim=0, return_inverse=True)
        else:
            states = active[:1]
            which = torch.zeros(len(active), dtype=torch.int64, device=active.device)
        for number, state in enumerate(states):
            index = torch.nonzero(which == number)[:, 0]
            groups += self._state(index, state, J_C[index], K[index], torque[index], wrench[index])
        return groups

    def _require_batch(self, batch: dict[str, Tensor], pad: bool) -> torch.Size:
        """Leading dimensions; raise TypeError or ValueError if the arguments of `forward` do not fit together."""
        for name, x in batch.items():
            if not isinstance(x, Tensor):
                raise TypeError(f"{name}: found {type(x).__name__}; accepted: a tensor")
        shapes = [tuple(x.shape) for x in batch.values()]
        rows = len(self.get_buffer("kept"))
        k = len(self.get_buffer("wrench_measured"))
        K = batch["K"]
        samples = batch["J_C"].shape[:-2]
        n = rows - self.base_rows
        widths = ((k, rows), (k,), (rows, *K.shape[-1:]), (n,), (k,))
        if shapes != [(*samples, *width) for width in widths] or not (pad or len(samples) == 1):
            B = "..." if pad else "B"
            accepted = f"({B}, {k}, {rows}), ({B}, {k}), ({B}, {rows}, P), ({B}, {n}), ({B}, {k})"
            raise ValueError(f"{', '.join(batch)}: found shapes {', '.join(map(str, shapes))}; accepted: {accepted}")
        for name, x in batch.items():
            expected = torch.bool if name == "active" else K.dtype
            if x.dtype != expected:
                suffix = "" if name == "active" else ", the dtype of K"
                raise TypeError(f"{name}: found {x.dtype}; accepted: {expected}{suffix}")
        return samples

    def _runs_compiled(self, K: Tensor) -> bool:
        return self._compiles and K.is_cpu and K.dtype in (torch.float64, torch.float32)

    def _padded(
        self, samples: torch.Size, out: ProjectedGroup | None, differentiable: bool, *arguments: Tensor
    ) -> ProjectedGroup:
        """One group of all samples."""
        (J, active, K, _, _) = arguments
        if out is not None and differentiable:
            raise TypeError("out: found arguments that require a gradient; accepted: no out, or torch.no_grad()")
        memory = None if out is None else self._memory(out, samples, K)
        sensors = self._sensors(K.dtype)
        if self._runs_compiled(K):
            flat = [x.detach().flatten(0, len(samples) - 1) if samples else x.detach()[None] for x in arguments]
            inputs = (*flat, sensors.constants, self.base_rows, sensors.floor, sensors.tolerance)
            if memory is None:
                memory = project(*inputs)
            else:
                write_projection(*inputs, memory)
                for x in memory:
                    if not x.is_inference():
                        torch.autograd.graph.increment_version(x)
            V, projected, f = (x.reshape(*samples, *x.shape[1:]) for x in memory)
            if differentiable:
                basis = V[..., sensors.kept, :] * sensors.row_std[:, None]
                V = sensors.whitened(basis, J, active) if J.requires_grad else V
                projected, f = sensors.products(V, *arguments)
        else:
            V, projected, f = sensors.project(*arguments)
            if out is not None:
                V, projected, f = (
                    x.copy_(made) for x, made in zip((out.V, out.K, out.f), (V, projected, f), strict=True)
                )
        index = torch.arange(samples.numel(), device=J.device).reshape(samples)
        return ProjectedGroup(index, active, V, projected, f, self.base_rows)

    def _memory(self, out: ProjectedGroup, samples: torch.Size, K: Tensor) -> list[Tensor]:
        """The tensors of `out`, (B, ...) each; raise ValueError if they have other shapes than the result."""
        rows = len(self.kept)
        m = len(self.rows)
        tensors = {"V": out.V, "K": out.K, "f": out.f}
        for (name, x), shape in zip(tensors.items(), ((rows, m), (m, K.shape[-1]), (m,)), strict=True):
            if x.shape != (*samples, *shape) or x.dtype != K.dtype or not x.is_contiguous():
                accepted = f"{(*samples, *shape)} {K.dtype}, contiguous: what an earlier call returned"
                raise ValueError(f"out.{name}: found {tuple(x.shape)} {x.dtype}; accepted: {accepted}")
        return [x.view(-1, *x.shape[len(samples) :]) for x in tensors.values()]

    def _sensors(self, dtype: torch.dtype) -> Sensors:
        """What is measured, in a precision."""
        kept, unmeasured, measured = (self.get_buffer(name) for name in ("rows", "unmeasured", "measured"))
        if self._whiten:
            row_std = self.get_buffer("row_std").to(dtype)[kept]
            wrench_std = self.get_buffer("wrench_std").to(dtype)[measured]
        else:
            row_std = torch.ones_like(kept, dtype=dtype)
            wrench_std = row_std[:0]
        eps = torch.finfo(dtype).eps
        tolerance = relative_tolerance(KINEMATIC_TOLERANCE, (len(unmeasured), len(kept)), eps)
        floor = _ROUNDINGS * eps * self._size
        return Sensors(kept, unmeasured, measured, row_std, wrench_std, self.base_rows, floor, tolerance)

    def _state(
        self, index: Tensor, state: Tensor, J: Tensor, K: Tensor, torque: Tensor, wrench: Tensor
    ) -> list[ProjectedGroup]:
        kept = self.get_buffer("kept")
        measured = self.get_buffer("wrench_measured") & state
        J_m = J[:, measured]
        f = torch.zeros_like(K[:, :, 0])
        f[:, self.base_rows :] = torch.where(self.get_buffer("torque_measured"), torque, torch.zeros_like(torque))
        f = f + (J_m.mT @ wrench[:, measured, None])[..., 0]
        groups = []
        for rows, basis in self._bases(J[:, state & ~self.get_buffer("wrench_measured")], J_m, measured):
            V = basis.new_zeros(basis.shape[0], len(kept), basis.shape[2])
            V[:, kept] = basis
            projected = V.mT @ K[rows], (V.mT @ f[rows, :, None])[..., 0]
            groups.append(ProjectedGroup(index[rows], state, V, *projected, self.base_rows))
        return groups

    def _bases(self, J_x: Tensor, J_m: Tensor, measured: Tensor) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """Null-space bases on the rows of the base and of measured torques."""
        kept = self.get_buffer("kept")
        if not self._whiten:
            return null_space(J_x[:, :, kept])
        row_std, wrench_std = (self.get_buffer(name).to(J_x) for name in ("row_std", "wrench_std"))
        return whitened_null_space(J_x[:, :, kept], row_std[kept], J_m[:, :, kept], wrench_std[measured])


def base_singular_values(V: Tensor) -> Tensor:
    """Singular values of S_b V_x, (..., 6), zeros where there are fewer; V: (..., n_rows, r), orthonormal."""
    values = torch.linalg.svdvals(V[..., :6, :])
    return nn.functional.pad(values, (0, 6 - values.shape[-1]))


def base_rank(singular_values: Tensor) -> Tensor:
    """rank(S_b V_x), (...), from `base_singular_values`."""
    tolerance = max(BASE_RANK_TOLERANCE, 100.0 * torch.finfo(singular_values.dtype).eps)
    return (singular_values > tolerance).sum(-1)


def null_space(A: Tensor, size: float | Tensor = 1.0) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Orthonormal bases of the null spaces of a batch of matrices, grouped by rank.

    Samples of full row rank use a QR factorization of the transpose. Samples that may have lost rank (straight knees)
    use a singular value decomposition. The basis of a null space is arbitrary, and so is its gradient. Functions of the
    null space alone, such as `V V^T` or the norm of `V^T f`, have the right gradient as long as the rank does not
    change. Where it changes there is no derivative; the returned gradient is that along motions of constant rank.

    Args:
        A: (B, k, m); with gradient if it requires one.
        size: size of the terms that are summed in its entries; 1 for the work of unit wrenches. Singular values below
            the rounding error of this size count as zero.

    Yields:
        (index of the samples, V): V is (B', m, m - rank) with `A @ V = 0` and `V^T V = I`.
    """
    floor = _ROUNDINGS * torch.finfo(A.dtype).eps * size
    for index, V in _bases(A.detach(), floor):
        yield index, _differentiable(A[index], V, floor) if A.requires_grad else V


def whitened_null_space(
    A: Tensor,
    row_std: Tensor,
    J_m: Tensor,
    wrench_std: Tensor,
    axes: Tensor | None = None,
    order: Tensor | None = None,
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Bases W of the null spaces of A under which the projected sensor noise is white, grouped by rank.

    Args:
        A: (B, k, m), with `axes` the six base rows of the generalized force first.
        row_std: (m,), > 0, noise of the generalized force itself (torque sensors, floor of the base rows) [N, N m].
        J_m: (B, k_m, m), rows of the contact Jacobian whose wrench component is measured.
        wrench_std: (k_m,), noise of each measured wrench component [N, N m].
        axes: (B, 3, 3), columns are unit vectors in the base frame: the axes of the base rows of `row_std`; None for
            the axes of the base.
        order: (m,) int64, order of the m rows; if A is empty, column i of W is zero except in the first i + 1 of them.

    Yields:
        (index of the samples, W): W is (B', m, m - rank) with `A @ W = 0` and `W^T S W = I`, where S, the covariance of
        the generalized force, is `diag(row_std^2) + J_m^T diag(wrench_std^2) J_m`. Gradients as in `null_space`.
    """
    if axes is not None:
        axes = axes.detach()
        for index, W in whitened_null_space(_along(A, axes), row_std, _along(J_m, axes), wrench_std, None, order):
            yield index, _along(W.mT, axes[index].mT).mT
        return
    if not A.shape[1]:
        order = torch.arange(A.shape[2], device=A.device) if order is None else order
        yield slice(None), _triangular_root(row_std, J_m, wrench_std, order)
        return
    for index, V in null_space(A / row_std, torch.linalg.vector_norm(1.0 / row_std).double()):
        W = V / row_std[:, None]  # white already, as far as the rows' own noise goes
        if len(wrench_std):
            through_contacts = (J_m[index] @ W) * wrench_std[:, None]
            identity = torch.eye(W.shape[2], dtype=W.dtype, device=W.device)
            L = _cholesky(identity + through_contacts.mT @ through_contacts)
            W = torch.linalg.solve_triangular(L, W.mT, upper=False).mT
        yield index, W


def _triangular_root(row_std: Tensor, J_m: Tensor, wrench_std: Tensor, order: Tensor) -> Tensor:
    """W, (B, m, m), with `W^T S W = I` and S as in `whitened_null_space`; column i is zero but in `order[:i + 1]`."""
    samples, _, m = J_m.shape
    identity = torch.eye(m, dtype=J_m.dtype, device=J_m.device)
    if not len(wrench_std):
        return (identity / row_std)[:, order].expand(samples, m, m)
    through_contacts = (J_m / row_std)[..., order] * wrench_std[:, None]
    L = _cholesky(identity + through_contacts.mT @ through_contacts)
    inverse = torch.linalg.solve_triangular(L, identity.expand_as(L), upper=False).mT
    return inverse[:, order.argsort()] / row_std[:, None]


def _cholesky(covariance: Tensor) -> Tensor:
    """Lower triangles of matrices (B, r, r) that are at least the identity. Only non-finite numbers can make it fail.

    On a CPU a failure raises. On a GPU the check would synchronize, so the result is not finite instead.
    """
    L: Tensor = torch.linalg.cholesky_ex(covariance, check_errors=covariance.device.type == "cpu").L
    return L


def _along(X: Tensor, axes: Tensor) -> Tensor:
    """Rows (B, k, m) with the force and moment on the base expressed along other axes."""
    return torch.cat([X[..., :3] @ axes, X[..., 3:6] @ axes, X[..., 6:]], dim=-1)


def _bases(A: Tensor, floor: float | Tensor) -> Iterator[tuple[Tensor | slice, Tensor]]:
    samples, k, m = A.shape
    if samples == 0:
        return
    identity = torch.eye(m, dtype=A.dtype, device=A.device)
    tolerance = _tolerance(A)
    if k == 0:
        yield slice(None), identity.expand(samples, m, m)
        return
    suspect = torch.ones(samples, dtype=torch.bool, device=A.device)
    if k <= m:
        reflectors, tau = torch.geqrf(A.mT)
        R = reflectors[:, :k].triu()
        inverse = torch.linalg.solve_triangular(R, identity[:k, :k].expand_as(R), upper=True)
        negligible = (tolerance * torch.linalg.matrix_norm(R)).clamp_min(floor)
        ratio = negligible * torch.linalg.matrix_norm(inverse)
        suspect = ~(ratio < 1.0 / _SUSPECT)  # so written, infinite and undefined ones are suspect too
        if A.device.type == "cpu":
            V = torch.ormqr(reflectors, tau, identity[:, k:].expand(samples, m, m - k))
        else:
            V = complement(reflectors, tau)
        if not any_suspect(suspect):
            yield slice(None), V
            return
        regular = torch.nonzero(~suspect)[:, 0]
        if len(regular):
            yield regular, V[regular]
    remaining = torch.nonzero(suspect)[:, 0]
    _, values, Vh = torch.linalg.svd(A[remaining], full_matrices=True)
    rank = (values > (tolerance * values[:, :1]).clamp_min(floor)).sum(1)
    for r in rank.unique().tolist():
        same = rank == r
        yield remaining[same], Vh[same, r:].mT


def complement(reflectors: Tensor, tau: Tensor) -> Tensor:
    """The last m - k columns of Q, (B, m, m - k), from what `torch.geqrf` returns of (B, m, k).

    All samples at once, from the product of their reflections in closed form, `1 - Y T Y^T` (Schreiber, Van Loan 1989).
    Faster on a GPU, where `torch.ormqr` works sample by sample; slower on a CPU.
    """
    m, k = reflectors.shape[1:]
    Y = reflectors.tril(-1)
    Y.diagonal(dim1=1, dim2=2).fill_(1.0)
    D = tau[:, :, None]
    last = Y[:, k:].mT  # Y^T of the last columns of the identity
    T_last = torch.linalg.solve_triangular(D * (Y.mT @ Y).triu(1), D * last, upper=True, unitriangular=True)
    return nn.functional.pad(torch.eye(m - k, dtype=Y.dtype, device=Y.device), (0, 0, k, 0)) - Y @ T_last


def any_suspect(suspect: Tensor) -> bool:
    """Whether any sample needs its singular values.

    All later shapes depend on this number, so it is the only one of a chunk that the host waits for.
    """
    return bool(suspect.any())


def _differentiable(A: Tensor, V: Tensor, floor: float | Tensor) -> Tensor:
    """Bases `V` as functions of A: projected onto the null space of A and made orthonormal again.

    Their value does not change but by rounding. To first order dV = -A^+ dA V (Golub, Pereyra 1973).
    """
    inverse = torch.linalg.pinv(A, atol=float(floor), rtol=_tolerance(A))
    inside = V - inverse @ (A @ V)
    L = torch.linalg.cholesky(inside.mT @ inside)
    return torch.linalg.solve_triangular(L, inside.mT, upper=False).mT


def _tolerance(A: Tensor) -> float:
    return relative_tolerance(KINEMATIC_TOLERANCE, A.shape[1:], torch.finfo(A.dtype).eps)
