"""From what a wrist device saw to a hand: laser points on their plane, and the flexion that puts them there."""
