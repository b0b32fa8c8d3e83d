"""Leak-free recordings beside the one that is judged."""
