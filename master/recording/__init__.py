"""Recordings of messages.

What a master received and published, kept in one file, and played again.
"""
