"""The card's line: disparity, depth by the rig's model, 1 € filter, palm, FABRIK per finger."""
