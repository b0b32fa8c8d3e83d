"""The page and the tables of a campaign's result."""
