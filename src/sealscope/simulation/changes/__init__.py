"""What changes slowly within a run: the rig, its instruments."""
