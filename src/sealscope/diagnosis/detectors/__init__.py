"""What every detector promises, which there are, and how they are run."""
