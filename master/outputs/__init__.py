"""Where solved hands go: one seam, one file per sink."""
