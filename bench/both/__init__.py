"""One hand before marker cameras and with a wrist device: scenes, messages, scores."""
