"""What loggers do to samples, and how it is undone before a recording is judged."""
