"""The volume balance: pump flow that the piston does not displace has leaked."""
