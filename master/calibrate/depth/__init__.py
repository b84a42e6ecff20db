"""Depth from disparity, from a target at known distances; and how right a rig is."""
