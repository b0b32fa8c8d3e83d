"""The estimator of a stream as kernels on one state record, which run compiled, in units, as C and as ST."""
