"""Every case, table and figure of the thesis as data, and how each is reproduced."""
