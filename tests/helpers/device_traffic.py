"""What a computation would make a GPU wait for: its exchanges with the host, found without one.

Tensors on torch's device "meta" have shapes and no values. They stand for those of a GPU here: whatever needs their
values on the host, or brings values from there, would stop the host until the GPU has come so far.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import torchid

DEVICE = torch.device("meta")
_PACKAGE = Path(torchid.__file__).parent
_aten = torch.ops.aten

#: Operators whose result, or its shape, the host waits for.
_WAITS = {
    "_local_scalar_dense": "a number",
    "is_nonzero": "a decision",
    "equal": "a decision",
    "nonzero": "a shape",
    "masked_select": "a shape",
    "_unique2": "a shape",
    "unique_dim": "a shape",
    "unique_consecutive": "a shape",
    "repeat_interleave": "a shape",
    "bincount": "a shape",
    "_linalg_check_errors": "a verdict on a factorization",
    "_linalg_svd": "convergence",
    "_linalg_eigh": "convergence",
    "linalg_lstsq": "a rank",
    "linalg_pinv": "a rank",
}
_INDEXED = ("index", "index_put", "index_put_", "_index_put_impl_")
_FROM_LISTS = (torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor)
_TO_HOST = (Tensor.tolist, Tensor.numpy, Tensor.cpu)


class DeviceTraffic(TorchDispatchMode):
    """Counts by line of the package what passes between host and device; `decisions` are answered with False."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()
        self._lists = _Lists(self.note)

    def __enter__(self) -> DeviceTraffic:
        self._lists.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self._lists.__exit__(*error)

    def note(self, what: str) -> None:
        """Count something at the line of the package that asked for it."""
        frames = [frame for frame in traceback.extract_stack() if Path(frame.filename).is_relative_to(_PACKAGE)]
        where = "tests" if not frames else f"{Path(frames[-1].filename).relative_to(_PACKAGE)}, {frames[-1].name}"
        self.found[f"{where}: {what}"] += 1

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        name = func.overloadpacket.__name__
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        devices = {x.device for x in tensors if x.ndim or x.device == DEVICE}  # numbers of the host go with the launch
        if tensors and kwargs.get("device") is not None:
            devices.add(torch.device(kwargs["device"]))
        if DEVICE in devices:
            if name in _WAITS:
                self.note(f"{name} ({_WAITS[name]})")
            if kwargs.get("check_errors"):
                self.note(f"{name} (a verdict on a factorization)")
            if name in _INDEXED and any(x is not None and x.dtype == torch.bool for x in args[1]):
                self.note(f"{name} by a mask (a shape)")
            if len(devices) > 1:
                self.note(f"{name} of tensors here and there")
        return _answer(name, func, args, kwargs)


def _answer(name: str, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """What the operator returns, on the device without values too."""
    if name == "_local_scalar_dense" and args[0].device == DEVICE:
        return False
    if name in ("geqrf", "ormqr") and args[0].device == DEVICE:  # shapes alone; torch has no such kernels
        if name == "ormqr":
            return torch.empty_like(args[2])
        if func is _aten.geqrf.a:
            return kwargs["a"], kwargs["tau"]
        return torch.empty_like(args[0]), args[0].new_empty(*args[0].shape[:-2], min(args[0].shape[-2:]))
    return func(*args, **kwargs)


class _Lists(TorchFunctionMode):
    """Notes tensors made of numbers of Python, as values or as an index: each is a copy to the device."""

    def __init__(self, note: Callable[[str], None]) -> None:
        super().__init__()
        self._note = note

    def __torch_function__(
        self, func: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func in _TO_HOST and args[0].device == DEVICE:
            self._note(f"{func.__name__} (a copy to the host)")
        elif func in _FROM_LISTS and not isinstance(args[-1], Tensor):
            device = args[0].device if func is Tensor.new_tensor else torch.device(kwargs.get("device") or "cpu")
            if device == DEVICE:
                self._note(f"{func.__name__} (a copy to the device)")
        elif func in (Tensor.__getitem__, Tensor.__setitem__) and args[0].device == DEVICE:
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(x, list | range) for x in index):
                self._note("index by a list (a copy to the device)")
        return func(*args, **kwargs)
