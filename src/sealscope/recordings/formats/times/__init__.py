"""Times: those of the samples, and when a recording was made."""
