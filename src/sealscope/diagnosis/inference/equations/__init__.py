"""The volume balances of a machine: samples of its channels, the terms made of them, and the equations."""
