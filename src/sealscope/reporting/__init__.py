"""Pages and texts of diagnoses and campaigns."""
