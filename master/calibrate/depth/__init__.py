"""Depth from disparity: a target at known distances enters, the law leaves."""
