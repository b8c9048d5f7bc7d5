"""Simulations whose processes are forks of this one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def forked_simulations() -> Iterator[None]:
    """Processes of `simulate` have nothing to import, which takes each of a user's 3 s."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("torchid.commands.simulate.START", "fork")
        yield
