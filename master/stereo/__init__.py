"""From 2D markers of N cameras to 3D markers at one instant."""
