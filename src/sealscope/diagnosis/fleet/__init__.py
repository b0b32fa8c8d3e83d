"""Many actuators watched live: details, windowed RMS and sequential tests."""
