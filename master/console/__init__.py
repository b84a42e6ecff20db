"""Web console on the master's PC that shows, tunes, records and sets up.

It runs as a process of its own.
"""
