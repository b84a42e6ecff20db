"""Wrist device: lit pictures of boards enter, laser plane and flat field leave."""
