"""Sources of a monitor's samples: files, lines, MQTT, Sparkplug B and OPC UA."""
