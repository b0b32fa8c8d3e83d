"""Evidence on leakage from pressures and command alone, by the response of the pressures to the command."""
