"""Publish and subscribe: messages enter by stream and name, leave to readers."""
