"""Appendix C: the 41 tests, and the success rates counted from them."""
