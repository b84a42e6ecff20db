"""Live outputs to other people's programs: one process beside the master, fed from the bus, which never slows it."""
