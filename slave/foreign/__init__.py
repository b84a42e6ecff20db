"""Videos and pictures of cameras that are not ours: whose they are, when they were taken, as a recording."""
