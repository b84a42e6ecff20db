"""Simulation of the wrist device.

What its camera sees of the hand by ambient light, by its laser and by its LEDs.
"""
