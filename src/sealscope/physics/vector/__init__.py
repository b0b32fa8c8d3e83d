"""Many runs at once: the same physical laws on lanes, each lane of a vector register being one of eight runs."""
