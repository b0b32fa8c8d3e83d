"""A machine commissioned once: the lessons of its healthy recordings, saved and used everywhere."""
