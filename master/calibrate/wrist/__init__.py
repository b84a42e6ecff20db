"""Calibration of a wrist device.

Laser plane, light of the LEDs, the palm before it, how each finger curls.
"""
