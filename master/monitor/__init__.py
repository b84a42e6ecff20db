"""Watch what the rig measures for what is wrong with it: clocks that lag."""
