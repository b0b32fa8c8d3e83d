"""Every case, table and figure of the thesis as data, and the code that reproduces each."""
