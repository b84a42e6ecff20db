"""Laser and LEDs of a wrist device.

Who switches them, when, and within which limits.
"""
