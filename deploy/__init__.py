"""Starts and orchestrates processes by their command lines.

It imports none of the packages it starts.
"""
