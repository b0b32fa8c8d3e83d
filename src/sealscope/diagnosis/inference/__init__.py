"""One inference: the balance of volumes in weak form, information in blocks, one decision."""
