"""The volume balance as a leak detector: tests of a recording, the leakage, and other causes of a change."""
