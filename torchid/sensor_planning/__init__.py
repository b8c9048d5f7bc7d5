"""The cheapest sensors for a scenario, redundant sensors, and the observability of the base with a proposed set."""
