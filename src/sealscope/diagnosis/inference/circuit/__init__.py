"""Further volume balances that a hydraulic circuit allows: over whole cycles and holds, and of the accumulator."""
