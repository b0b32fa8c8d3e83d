"""Estimation: models of normal errors that all inference of the diagnosis shares."""
