"""Laser and LEDs of a wrist device: who switches them, when, and within which limits."""
