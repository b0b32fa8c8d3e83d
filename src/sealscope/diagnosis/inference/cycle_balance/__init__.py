"""The balance of volumes over whole cycles, after which the piston is where it was."""
