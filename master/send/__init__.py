"""Live outputs to other people's programs.

One process beside the master, fed from the bus, which never slows it.
"""
