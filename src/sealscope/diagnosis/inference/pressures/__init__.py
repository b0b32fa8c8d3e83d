"""Evidence from pressures and command in the inference's blocks; not yet what `diagnose` judges pressures by."""
