"""Checks of a log before it is fitted: what is wrong with it, where, and what to do."""

from torchid.log_checks.check import Checked, check, drop_condemned
from torchid.log_checks.findings import CONDEMNED, NOTE, SUSPICIOUS, Finding, Skipped, Span

__all__ = ["CONDEMNED", "Checked", "Finding", "NOTE", "SUSPICIOUS", "Skipped", "Span", "check", "drop_condemned"]
