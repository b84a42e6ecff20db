"""From 3D markers to joint angles: joints, finger, fabrik, hand."""
