"""The compiled kernels of the modules as operators of torch: `torch.compile`, `export`, `vmap` and `func` know them.

Each takes its tensors, (B, width), then `table` and `reals` of `robot_tables`, the numbers of rows and columns of K,
and the number of a `Referenced`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, pairwise
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from torchid import kernels, parameters
from torchid.parameters import Array
from torchid.regressor.tree import KinematicTree

Operator = Callable[..., Tensor]

_library = torch.library.Library("torchid", "DEF")
_NO_COLUMNS = [-1] * parameters.PER_BODY


def robot_tables(
    tree: KinematicTree,
    columns: Sequence[Sequence[int]],
    frames: Array,
    gravity: Sequence[float],
    frame: tuple[int, Array] | None = None,
) -> tuple[Tensor, Tensor]:
    """Constants of a robot as kernels read them, whole numbers and others; see `Robot` in `kernels/modules.cpp`.

    Args:
        tree: the robot's constants.
        columns: of each node, where its ten inertial parameters, fc and fv are in K, -1 where they are not; () for a
            node that no column depends on.
        frames: (L, 4, 4), that the parameters are expressed in, in the nodes' joint frames.
        gravity: (3,) [m/s^2].
        frame: node that carries one, and its pose, (4, 4), in the node's joint frame: the tables then have the nodes
            that move it and the frame as the last.
    """
    joint_map = tree.joint_map.double().cpu().numpy()
    dofs = [next(iter(np.flatnonzero(row).tolist()), -1) for row in joint_map]
    members = range(tree.n_nodes) if frame is None else [0, *tree.path(frame[0])]
    number = {node: place for place, node in enumerate(members)}

    def row_terms(node: int) -> list[tuple[int, int, int]]:
        """Row, node whose joint moves it (-1 for the base) and whether the next adds to the same row."""
        joints = sorted(tree.path(node), key=lambda joint: dofs[joint])
        more = [*(dofs[a] == dofs[b] for a, b in pairwise(joints)), False]
        moved = [(tree.base_rows + dofs[x], number[x], int(again)) for x, again in zip(joints, more, strict=False)]
        return [(row, -1, 0) for row in range(tree.base_rows)] + moved

    nodes = list[list[int]]()
    terms = list[tuple[int, int, int]]()
    for node in members:
        felt = row_terms(node) if columns[node] else []
        moves = 0 <= dofs[node] < tree.n
        framed = not np.array_equal(frames[node], np.eye(4))
        first = [number[max(tree.parents[node], 0)], tree.slides[node], dofs[node], moves, framed]
        nodes.append([*first, len(terms), len(felt), *(columns[node] or _NO_COLUMNS)])
        terms += felt
    poses = tree.T_parent_joint[:, :3].reshape(-1, 12), frames[:, :3].reshape(-1, 12)
    positions = joint_map.sum(axis=1), tree.joint_constant.double().cpu().numpy()[:, 0]
    reals = np.column_stack([*poses, *positions])[list(members)]
    if frame is not None:
        felt = row_terms(frame[0])
        nodes.append([number[frame[0]], 1, -1, 0, 0, len(terms), len(felt), *_NO_COLUMNS])
        terms += felt
        reals = np.vstack([reals, np.pad(frame[1][:3].ravel(), (0, reals.shape[1] - 12))])
    count = max((column + 1 for own in columns for column in own), default=0)
    table = [len(nodes), tree.n, tree.base_rows, tree.n_dofs, count, *chain(*nodes), *chain(*terms)]
    constants = [*gravity, tree.sign_width or 0.0, *reals.ravel().tolist()]
    return torch.tensor(table), torch.tensor(constants, dtype=torch.float64)


class Referenced(nn.Module):
    """A module with operators, which find it by a number where torch's own way to compute the same is needed.

    `number`: this. `has_kernels`: whether the operators may be called.
    """

    def __init__(self) -> None:
        super().__init__()
        self._register()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._register()

    def _register(self) -> None:
        self.number = id(self)
        self.has_kernels = kernels.compiled() is not None
        _references[self.number] = self

    def runs_compiled(self, x: Tensor) -> bool:
        """Whether operators compute something of such a tensor."""
        return self.has_kernels and x.is_cpu and x.dtype in (torch.float64, torch.float32)

    def extra_repr(self) -> str:
        """What `repr` says."""
        return "" if self.has_kernels else kernels.why_not_compiled()

    def reference(self, *arguments: Tensor) -> Tensor:
        """The operator's result, by torch's operators."""
        raise NotImplementedError


_references: WeakValueDictionary[int, Referenced] = WeakValueDictionary()


def marked(out: Tensor, number: int) -> Tensor:
    """The tensor, with a mark that says which module wrote it last, and its version then."""
    if not torch.compiler.is_compiling():
        out.__dict__["torchid_writer"] = number, _version(out)
    return out


def is_marked(out: Tensor, number: int) -> bool:
    """Whether a module wrote a tensor, and nobody since; writes in inference mode go unnoticed."""
    return not torch.compiler.is_compiling() and out.__dict__.get("torchid_writer") == (number, _version(out))


def _version(x: Tensor) -> int:
    return -1 if x.is_inference() else x._version


_INPUTS = ("q", "v", "a", "phi")


def _run(inputs: Sequence[Tensor], table: Tensor, reals: Tensor, *rest: kernels.Word) -> None:
    """Call a kernel; `rest`: the fields of `Call` in `kernels/modules.cpp` after its inputs and their sizes."""
    (q, last) = (inputs[0], inputs[-1])
    fields: list[kernels.Word] = [x.contiguous() for x in inputs]
    fields += [0] * (len(_INPUTS) - len(inputs))
    sizes = len(q), 0 if last.ndim == 1 else last.shape[1]
    kind = "frame" if len(inputs) == 1 else "dynamics"
    name = f"torchid_{kind}_{str(q.dtype).removeprefix('torch.')}"
    kernels.call(name, table, reals, (*fields, *sizes, *rest), torch.get_num_threads())


def _shape(inputs: Sequence[Tensor], rows: int, columns: int) -> tuple[int, ...]:
    samples = inputs[0].shape[0]  # len would make a number of a symbol
    return {1: (6, rows, samples), 3: (rows, columns, samples), 4: (samples, rows)}[len(inputs)]


def _write(*arguments: Any) -> None:
    *inputs, table, reals, out = arguments
    _run(inputs, table, reals, 0, 0, 0, 0, out, 0, 0, 0, 0)


def _compute(*arguments: Any) -> Tensor:
    *inputs, table, reals, rows, columns, _ = arguments
    out: Tensor = inputs[0].new_zeros(_shape(inputs, rows, columns))
    _write(*inputs, table, reals, out)
    return out


def _imagine(*arguments: Any) -> Tensor:
    *inputs, _, _, rows, columns, _ = arguments
    return inputs[0].new_empty(_shape(inputs, rows, columns))


def _gradients(grad: Tensor, inputs: list[Tensor], table: Tensor, reals: Tensor, of_state: bool) -> list[Tensor]:
    """Gradients of the inputs, by that of what `_compute` makes of them; of parameters for each sample.

    `of_state`: whether those of q, v and a are wanted; else they are not computed.
    """
    out = [x.new_zeros(len(inputs[0]), x.shape[-1]) for x in inputs]
    (first, second, third) = (*grad.stride(), 0)[:3]
    strides = (first, second, third) if len(inputs) == 4 else (third, first, second)  # of samples, rows, columns
    wanted: list[kernels.Word] = [x if of_state or name == "phi" else 0 for name, x in zip(_INPUTS, out, strict=False)]
    wanted += [0] * (len(_INPUTS) - len(inputs))
    _run(inputs, table, reals, grad.data_ptr(), *strides, 0, *wanted)
    return out


class _Differentiable(torch.autograd.Function):
    """An operator with its gradient; what is mapped over becomes samples of one batch."""

    @staticmethod
    def forward(operator: Operator, *arguments: Any) -> Tensor:
        return operator(*arguments)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, *tensors, _, _, number = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)
        ctx.number = number

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: Any) -> Tensor:
        inputs = ctx.saved_tensors[:-2]
        along = tuple(torch.zeros_like(x) if t is None else t for x, t in zip(inputs, tangents, strict=False))
        out: Tensor = torch.func.jvp(_references[ctx.number].reference, inputs, along)[1]
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, table, reals = ctx.saved_tensors
        if torch.is_grad_enabled():  # to be differentiated again
            gradients = torch.func.vjp(_references[ctx.number].reference, *inputs)[1](grad)
        else:
            of_state = any(ctx.needs_input_grad[-5 - len(inputs) :][:3])
            gradients = torch.ops.torchid.gradients(grad, inputs, table, reals, of_state)
            gradients = [g.sum(0) if x.ndim == 1 else g for g, x in zip(gradients, inputs, strict=True)]
        return (None, *gradients, None, None, None, None, None)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], operator: Operator, *arguments: Any) -> tuple[Tensor, int]:
        return _mapped(partial(call, operator), info.batch_size, in_dims[1:], *arguments)


def call(operator: Operator, *arguments: Any) -> Tensor:
    """Call an operator with its gradient, which `torch.func` knows of functions only, `torch.compile` of operators."""
    if torch.compiler.is_compiling() or not (torch.is_grad_enabled() and _differentiated(arguments)):
        return operator(*arguments)
    out: Tensor = _Differentiable.apply(operator, *arguments)
    return out


def _differentiated(arguments: tuple[Any, ...]) -> bool:
    """Whether somebody may ask for derivatives. To call the function all the same takes 40 us."""
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        return True
    return any(isinstance(x, Tensor) and x.requires_grad for x in arguments)


def _mapped(function: Operator, size: int, dims: Sequence[int | None], *arguments: Any) -> tuple[Tensor, int]:
    """What an operator makes of batches, and the dimension of these."""
    *inputs, table, reals, rows, columns, number = arguments
    batches = [
        x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0) for x, dim in zip(inputs, dims, strict=False)
    ]
    samples = batches[0].shape[1]
    alike = [(x if x.ndim == 3 else x[:, None].expand(-1, samples, -1)).flatten(0, 1) for x in batches]
    dim = 0 if len(inputs) == 4 else 2
    return function(*alike, table, reals, rows, columns, number).unflatten(dim, (size, samples)), dim


def _operator(name: str, inputs: int) -> Operator:
    """An operator of so many inputs."""
    schema = f"{', '.join(f'Tensor {x}' for x in _INPUTS[:inputs])}, Tensor table, Tensor reals"
    _library.define(f"{name}({schema}, int rows, int columns, int number) -> Tensor")
    _library.impl(name, _compute, "CPU")
    operator: Operator = getattr(torch.ops.torchid, name).default
    torch.library.register_fake(f"torchid::{name}", _imagine, lib=_library)
    torch.library.register_autograd(
        f"torchid::{name}",
        lambda ctx, grad: _Differentiable.backward(ctx, grad)[1:],
        setup_context=lambda ctx, inputs, output: _Differentiable.setup_context(ctx, (None, *inputs), output),
        lib=_library,
    )
    torch.library.register_vmap(
        f"torchid::{name}",
        lambda info, dims, *arguments: _mapped(operator, info.batch_size, dims, *arguments),
        lib=_library,
    )
    return operator


_library.define("gradients(Tensor grad, Tensor[] inputs, Tensor table, Tensor reals, bool of_state) -> Tensor[]")
_library.impl("gradients", _gradients, "CPU")
torch.library.register_fake(
    "torchid::gradients",
    lambda grad, inputs, table, reals, of_state: [x.new_empty(inputs[0].shape[0], x.shape[-1]) for x in inputs],
    lib=_library,
)

frame_jacobian = _operator("frame_jacobian", 1)
"""Jacobian of a robot's last node, (6, rows, B), of q."""
regressor = _operator("regressor", 3)
"""K, (rows, columns, B), of q, v and a."""
inverse_dynamics = _operator("inverse_dynamics", 4)
"""K phi, (B, rows), of q, v, a and parameters, (columns,) or (B, columns)."""

_library.define("write_regressor(Tensor q, Tensor v, Tensor a, Tensor table, Tensor reals, Tensor(a!) out) -> ()")
_library.impl("write_regressor", _write, "CPU")
torch.library.register_fake("torchid::write_regressor", lambda *arguments: None, lib=_library)
write_regressor: Callable[..., None] = torch.ops.torchid.write_regressor.default
"""As `regressor`, to `out`, but not its constant zeros."""
