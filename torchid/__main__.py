"""`python -m torchid`."""

from __future__ import annotations

from torchid.cli import run

run()
