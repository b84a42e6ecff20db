"""Beside the sensor: light in, small messages out."""
