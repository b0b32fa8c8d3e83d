"""Many runs at once: the laws on lanes, eight runs to a vector register."""
