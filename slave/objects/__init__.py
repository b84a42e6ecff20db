"""Devices that track themselves, such as a Vive tracker: one seam, one file per driver."""
