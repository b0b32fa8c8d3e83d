"""What else than a leak steps: the duty, the noise of the sensors, and the levels of the pressures."""
