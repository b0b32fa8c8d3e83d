"""Parameters of the rig fitted to the leak-free tests of Appendix C."""
