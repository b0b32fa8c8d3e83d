"""Chapter 4: the model and its simulation."""
