"""Benchmarks of marker detection on generated frames and real pictures."""
