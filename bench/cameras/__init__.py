"""Benchmarks of a rig of marker cameras: time, depth, covariance, occlusion."""
