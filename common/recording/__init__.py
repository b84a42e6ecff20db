"""Recordings on disk: messages and frames enter, and are read back exactly."""
