"""The language both sides of the wire speak."""
