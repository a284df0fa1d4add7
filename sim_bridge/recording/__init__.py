"""What the robot does, senses and records."""
