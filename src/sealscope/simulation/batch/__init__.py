"""Many experiments side by side, reduced to statistics as they run."""
