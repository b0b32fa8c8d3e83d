"""The rig as a functional mock-up unit (FMU), and recordings of other programs' units."""
