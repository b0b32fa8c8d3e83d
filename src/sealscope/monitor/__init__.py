"""Actuators watched live: a stream that keeps its state, the service around it, its memory, its alarms and its page."""
