"""Execution: a campaign's cases run in processes, batches or on a cluster; a folder stores their results."""
