"""What the monitor remembers: one database, one transaction a block."""
