"""Simulated rig: motions with exact truth, and the camera images of them.

No hardware is needed.
"""
