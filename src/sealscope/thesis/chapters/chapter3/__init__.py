"""Chapter 3: transforms and wavelets."""
