"""IMUs: one seam, one file per driver."""
