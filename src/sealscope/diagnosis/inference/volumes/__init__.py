"""The balance of volumes as a provider: its observables, its leak, and rivals of a rise."""
