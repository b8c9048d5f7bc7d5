"""What `torchid compress` prints."""

from __future__ import annotations

from dataclasses import asdict

from torchid.commands.compress import Compression
from torchid.report.tables import compression_table, print_tables, state_table
from torchid.terminal.lines import print_noise, print_rolling


def print_compression(done: Compression) -> None:
    """Print contact states, noise, and the files of factors."""
    print_tables(state_table([asdict(state) for state in done.states]))
    print_noise(done.noise)
    print_tables(compression_table([asdict(file) for file in done.files]))
    print_rolling(done.rolling)
    print(f"written to    {done.output}")
