"""Alarms against truth: how often, how soon and how surely a detector finds a leak, and how often it cries wolf."""
