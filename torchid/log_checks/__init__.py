"""Checks of a log before it is fitted: what is wrong with it, where, and what to do.

- `check` calls all in their order; `findings` are what they return
- of signals alone: `readings`, `spikes`, `motion`; of contacts and feet that stand: `contacts`, `standing_feet`
- of forces against a robot's dynamics: `forces`, which judges the rows of `unknowns` by one fit (`equations`) and
  tries `mistakes`

Every check module has the same order: thresholds, public check functions, helpers in order of call. Thresholds are
named MIN_ or MAX_, quantity, unit: `_SHARE` and `_RATIO` are dimensionless, `_STEPS` are median steps of the log.
"""

from torchid.log_checks.check import Checked, drop_rejected
from torchid.log_checks.findings import NOTE, REJECTED, SUSPICIOUS, Finding, Skipped, Span

__all__ = ["REJECTED", "Checked", "Finding", "NOTE", "SUSPICIOUS", "Skipped", "Span", "drop_rejected"]
