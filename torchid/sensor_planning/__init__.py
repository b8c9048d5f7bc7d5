"""Which sensors a scenario needs, which could be left out, and what a proposed set loses."""
