"""Hygiene of a log before it is fitted: what is wrong with it, where, and what to do."""

from torchid.hygiene.check import Checked, check
from torchid.hygiene.exclusion import without_condemned
from torchid.hygiene.finding import CONDEMNED, NOTE, SUSPICIOUS, Finding, Skipped, Span

__all__ = ["CONDEMNED", "NOTE", "SUSPICIOUS", "Checked", "Finding", "Skipped", "Span", "check", "without_condemned"]
