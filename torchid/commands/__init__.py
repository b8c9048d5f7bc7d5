"""Commands: whole runs from files to folders."""
