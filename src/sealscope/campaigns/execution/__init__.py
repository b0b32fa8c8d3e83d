"""Execution: a campaign's cases run in processes or on a cluster; a folder stores their results."""
