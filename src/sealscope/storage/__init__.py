"""Store results in files and folders: open them safely, write them atomically, refuse links out of a folder."""
