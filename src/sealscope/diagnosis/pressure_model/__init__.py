"""A reduced model of the rig, fitted to the pressure difference and followed block by block."""
