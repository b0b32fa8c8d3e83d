"""The volume balance of one running actuator: blocks in, estimates and alarms out, its state as plain data."""
