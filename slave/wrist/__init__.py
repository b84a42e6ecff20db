"""Beside the camera of a wrist device: from strobed frames to laser points and fingertips."""
