"""The cases, tables and figures of each chapter."""
