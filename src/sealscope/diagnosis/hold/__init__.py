"""The hold test: valves shut, a load held, and the leak read from how the piston sinks or the pressure falls."""
