"""Headings of tables: names and units of columns, the channels that they may mean, and remarks on the recording."""
