"""Publish and subscribe: messages enter by stream and name, readers get them."""
