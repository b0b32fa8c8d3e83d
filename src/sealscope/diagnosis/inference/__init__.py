"""Estimation of leakage from recordings: volume balances in weak form, likelihoods in blocks, and tests of both."""
