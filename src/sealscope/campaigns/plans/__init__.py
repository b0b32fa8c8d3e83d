"""Plans: the records of a campaign, simulated or read, and its detectors."""
