"""File formats: one file a format, and what they share."""
