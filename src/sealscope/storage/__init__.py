"""Files from outside and files of our own: opened safely, written whole, in folders that links do not leave."""
