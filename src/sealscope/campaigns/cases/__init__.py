"""Cases: one record each, from its name and seed to the row of its scores."""
