"""Rows of the regression: the weak form, their weights, and the distribution of the pressure."""
