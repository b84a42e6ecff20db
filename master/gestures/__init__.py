"""Hand gestures: held poses, pinches, dials, taps and pointing."""
