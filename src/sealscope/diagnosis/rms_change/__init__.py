"""The thesis's method: a change of the RMS of the db8 details."""
