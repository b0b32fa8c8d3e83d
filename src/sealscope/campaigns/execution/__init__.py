"""Execution: processes, batches or a cluster carry out the cases; rows are appended to the campaign's folder."""
