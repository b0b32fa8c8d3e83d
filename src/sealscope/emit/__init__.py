"""Compiled kernels as source text for controllers: C99 and Structured Text."""
