"""The rig as a functional mock-up unit (FMU), and other people's units as machines to record."""
