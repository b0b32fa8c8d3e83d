"""What a diagnosis states, and how the evidence of several detectors becomes one verdict."""
