"""The estimator of a stream as kernels on one state record, which run compiled, in a simulation unit, and as C and ST."""
