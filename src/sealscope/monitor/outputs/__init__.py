"""Outputs of a monitor's alarms and states: JSON lines, webhook, Prometheus and Sparkplug B."""
