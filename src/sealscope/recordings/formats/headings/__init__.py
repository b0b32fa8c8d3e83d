"""What stands above the samples: names and units of columns, what they may mean, and remarks on the recording."""
