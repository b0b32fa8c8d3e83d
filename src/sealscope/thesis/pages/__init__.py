"""The thesis's figures, tables and claims as files and as one page."""
