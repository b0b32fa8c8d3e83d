"""The testable sentences of the thesis and their verdicts."""
