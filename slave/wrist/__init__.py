"""Processing beside the camera of a wrist device.

From strobed frames to laser points and fingertips.
"""
