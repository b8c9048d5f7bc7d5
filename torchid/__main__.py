"""`python -m torchid`."""

import sys

from torchid.cli import main

sys.exit(main())
