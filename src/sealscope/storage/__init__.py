"""Files and folders of results: opened safely, written atomically, without links out of a folder."""
