"""A machine commissioned once: what its healthy recordings taught, written down and used everywhere."""
