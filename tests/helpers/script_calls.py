"""Scripts as modules, and run as from a command line."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import sys
from types import ModuleType

from repository import ROOT


def script(name: str) -> ModuleType:
    """A script as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def call(name: str, *arguments: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a script."""
    before, out, err = sys.argv, io.StringIO(), io.StringIO()
    sys.argv = [f"{name}.py", *arguments]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = script(name).main()
    finally:
        sys.argv = before
    return status, out.getvalue(), err.getvalue()
