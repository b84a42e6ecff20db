"""Rigid objects: markers, tags and tracker poses enter, poses and contact leave."""
