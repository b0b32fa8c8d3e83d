"""Where alarms go: JSON lines, Prometheus, a broker."""
