"""Motion capture of others: read it, hold poses against it, make a hand of it."""
