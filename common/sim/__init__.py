"""Simulated rig: a scene and a seed enter, exact truth and pictures leave."""
