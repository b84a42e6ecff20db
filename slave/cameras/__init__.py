"""Cameras: one seam, one file per driver."""
