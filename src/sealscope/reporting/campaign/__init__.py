"""A campaign's result as page and tables."""
