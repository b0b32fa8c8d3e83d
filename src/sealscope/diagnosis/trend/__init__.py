"""The trend of a single machine: its leakage over many recordings, in the order of time."""
