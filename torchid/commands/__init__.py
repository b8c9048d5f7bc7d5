"""Commands, from arguments to files and folders, and the formats that they write.

A module for each command: `analyze`, `check` (and `convert`), `compress`, `demo`, `evaluate`, `export`, `identify`,
`init`, `replay`, `sample`, `simulate`. What they are made of:

- a fit: `chosen_settings`, `training`, `plausibility`
- what `identify` returns and says: `results`, `answer`, and `run_folder`, which makes its page anew too
- parts of `init` and `analyze`: `init_parts`, `sensor_set_accuracy`
- folders: `folder`
"""

# here, where the command line finds them without the imports of the commands, which take long
EXPORT_FORMATS = ("mjcf", "urdf", "isaaclab", "json")
SAMPLE_FORMATS = ("npz", "urdf", "mjcf", "ranges")
