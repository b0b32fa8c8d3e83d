"""Plans: what a campaign simulates or reads, and which detectors judge it."""
