"""The monitor's page: the fleet, one actuator's life, and what a person says of its alarm."""
