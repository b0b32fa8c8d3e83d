"""Readers and writers of file formats, one module a format, and the functions that they share."""
