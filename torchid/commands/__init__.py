"""Commands, from arguments to files and folders, and the formats that they write."""

# here, where the command line finds them without the imports of the commands, which take long
EXPORT_FORMATS = ("mjcf", "urdf", "isaaclab", "json")
SAMPLE_FORMATS = ("npz", "urdf", "mjcf", "ranges")
