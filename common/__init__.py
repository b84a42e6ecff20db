"""What both sides share: messages, files, geometry, the hand; imports neither."""
