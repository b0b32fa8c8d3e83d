"""Watch a running machine: estimate its leakage block by block, and alarm at a stated rate of false alarms."""
