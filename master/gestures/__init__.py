"""Hand gestures: hand poses enter, held poses, pinches, dials and taps leave."""
