"""Many experiments at once, reduced to statistics while they run."""
