"""Benchmarks of tracked objects: beads, tags, trackers."""
