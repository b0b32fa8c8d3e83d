"""What a balance says, the questions asked of it, and the verdict."""
