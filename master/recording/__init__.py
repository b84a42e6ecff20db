"""Recordings of the bus: messages enter, MCAP files leave, and are played again."""
