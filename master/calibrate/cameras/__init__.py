"""Lenses and places of cameras: pictures of a board enter, their files leave."""
