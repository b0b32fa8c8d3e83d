"""Estimation of leakage from recordings by volume balances in weak form: likelihoods in blocks of time, and tests."""
