"""Rigid objects that the cameras see: where they are, and how near the hand is to them."""
