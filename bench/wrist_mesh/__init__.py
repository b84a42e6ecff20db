"""Recordings of the wrist camera that looks at a skinned mesh hand, with exact truth."""
