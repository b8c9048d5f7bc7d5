"""What a robot, its contacts, its sensors and its motion determine, and which sensors could be left out."""
