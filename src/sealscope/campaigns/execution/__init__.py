"""Execution: processes, batches or a cluster run the cases; rows are appended to the campaign's folder."""
