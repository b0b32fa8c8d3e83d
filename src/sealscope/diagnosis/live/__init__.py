"""The inference on a stream: blocks as they are closed, and a sequential test at a stated rate."""
