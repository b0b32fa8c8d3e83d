"""What a diagnosis states: verdict and evidence, the severity of a leak, the assumed machine and its state."""
