"""Lenses and places of cameras, from pictures of a board."""
