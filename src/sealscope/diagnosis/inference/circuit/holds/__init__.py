"""Times in which shut valves hold a cylinder's load: its leaks from the balances of both closed chambers."""
