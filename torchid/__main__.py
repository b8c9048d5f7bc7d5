"""`python -m torchid`."""

from __future__ import annotations

import sys

from torchid.cli import main

sys.exit(main())
