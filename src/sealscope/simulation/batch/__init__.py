"""Many experiments at once, reduced to statistics as they run."""
