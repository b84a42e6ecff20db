"""Benchmarks of the hand solver on points, and its peers."""
