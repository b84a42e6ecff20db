"""Bone lengths and marker places of a hand, from a guided routine."""
