"""Balances that a circuit allows where the cylinder alone does not: over cycles and holds, and of the accumulator."""
