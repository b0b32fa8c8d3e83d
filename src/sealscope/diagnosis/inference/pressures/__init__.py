"""Evidence from pressures and command alone: two hypotheses of the machine, the response and the ring."""
