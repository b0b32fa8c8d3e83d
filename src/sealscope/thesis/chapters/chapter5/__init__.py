"""Chapter 5: the ten tests shown."""
