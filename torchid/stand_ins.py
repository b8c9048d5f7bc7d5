"""Stand-ins for modules that libraries import for functions which nothing here calls: a third of all imports."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any

#: Modules, and what libraries take from them while they are imported themselves.
_UNUSED = {
    "torch._meta_registrations": (),  # what torch.compile has to know of operators: 0.3 s
    "scipy.stats": ("scoreatpercentile",),  # scipy.signal finds peaks of wavelets with it: 0.25 s
    "scipy.ndimage": ("convolve1d",),  # of scipy.signal and trimesh: 0.04 s
    "networkx": ("Graph",),  # graphs of meshes in trimesh: 0.07 s
    "pytorch_kinematics.mjcf": ("build_chain_from_mjcf", "build_serial_chain_from_mjcf"),  # MuJoCo, if any: 0.1 s
}


@contextmanager
def unused_modules_apart() -> Iterator[None]:
    """Let libraries that are imported within the block do without some modules until one is used, or imported later."""
    absent = {name: _StandIn(name, functions) for name, functions in _UNUSED.items() if name not in sys.modules}
    sys.modules.update(absent)
    try:
        yield
        if "torch" in sys.modules:
            import_module("torch._prims.rng_prims")  # torch's registrations do; without it no torch.Generator is made
    finally:
        for module in absent.values():
            module.leave()


class _StandIn(ModuleType):
    """Imports the module that it stands for once anything but its functions is looked up, or one of these is called."""

    def __init__(self, name: str, functions: tuple[str, ...]) -> None:
        super().__init__(name)
        self.__all__ = functions
        for function in functions:
            setattr(self, function, partial(self._call, function))

    def leave(self) -> None:
        """Whoever imports the module from now on gets the module."""
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]

    def _call(self, function: str, *arguments: Any, **options: Any) -> Any:
        return self.__getattr__(function)(*arguments, **options)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # imports and `inspect` look for them in all modules
            raise AttributeError(name)
        self.leave()
        return getattr(import_module(self.__name__), name)
