"""The order of a wrench's components: force, then moment, at a frame's origin along its axes."""

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
