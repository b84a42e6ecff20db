"""Benchmarks of recognised poses and actions of the hand."""
