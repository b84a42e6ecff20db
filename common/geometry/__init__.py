"""Geometry of no hand: points and rotations enter, transformed ones leave."""
