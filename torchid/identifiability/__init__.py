"""What a robot, its contacts, its sensors and its motion determine of the parameters, and how well."""
