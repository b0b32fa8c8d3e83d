"""The integration methods, and how long a step may be."""
