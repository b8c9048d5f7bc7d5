"""Which parameters a robot, its contacts, sensors and motion determine, and how accurately."""
