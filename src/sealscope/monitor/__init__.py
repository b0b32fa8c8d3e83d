"""Continuous watch of actuators: the service, its sources of samples, its database, its alarms and its web page."""
