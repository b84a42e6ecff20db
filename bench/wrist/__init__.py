"""Benchmarks of the wrist device: strobe cycles, tips, joint angles, calibration."""
