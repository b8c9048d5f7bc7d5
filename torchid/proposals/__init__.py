"""Proposed maps of foreign logs, from the names and some of the numbers in a file: what `torchid init` begins with."""
