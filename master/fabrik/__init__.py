"""The paper's line to a hand: filtered 3D markers, palm, FABRIK per finger."""
