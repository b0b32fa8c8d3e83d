"""The laws of the rig, compiled, on plain SI floats: one law, one function, one home."""
