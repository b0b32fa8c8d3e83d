"""The list of items to reproduce, and the code that makes and stores them and reuses stored results."""
