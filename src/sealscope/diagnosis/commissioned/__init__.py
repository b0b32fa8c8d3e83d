"""A machine commissioned once: the summaries of its healthy recordings, saved and used everywhere."""
