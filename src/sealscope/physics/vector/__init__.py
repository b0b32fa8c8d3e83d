"""The laws over lanes: eight runs to a vector register."""
