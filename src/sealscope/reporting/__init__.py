"""Pages and texts of diagnoses, campaigns and the reproduced thesis."""
