"""Alarms: their life, and what turns estimates into them."""
