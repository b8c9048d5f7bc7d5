"""Where the repository's own files are, and the real logs that may lie beside it."""

from __future__ import annotations

from pathlib import Path

import torchid

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
DEMO = Path(torchid.__file__).parent / "demo"
SHARED = ROOT.parent / "shared" / "data"
"""Logs of real robots and people, which are not part of the repository."""
