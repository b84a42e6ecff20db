"""Beside the sensor: light enters, small messages leave."""
