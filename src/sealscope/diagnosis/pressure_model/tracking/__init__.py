"""Parameters of a machine followed through the blocks of a record, and the steps of a leak in them."""
