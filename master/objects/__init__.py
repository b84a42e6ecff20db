"""Rigid objects that the cameras see.

Their poses, and how near the hand is to them.
"""
