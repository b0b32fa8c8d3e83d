"""Outputs of alarms and states: JSON lines, webhook, Prometheus, Sparkplug B."""
