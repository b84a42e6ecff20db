"""What a hand says: poses that it holds, pinches, dials, taps and pointing."""
