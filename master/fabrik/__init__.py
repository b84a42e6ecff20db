"""The card's line: disparity, depth, 1 € filter, palm, FABRIK per finger."""
