"""Files from outside and files of our own: opened safely, written whole, kept in folders that links do not leave."""
