"""Recordings of messages: what a master took and told, kept in one file, and played again."""
