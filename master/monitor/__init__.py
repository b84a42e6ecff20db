"""Monitors of a running rig: counts and times enter, warnings and health leave."""
