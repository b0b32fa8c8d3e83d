"""Changes within a recording, as observables: terms of the volume balance, motion, noise, hum, levels of pressure."""
