"""One state of a hand, fitted to the pixels of all sensors; compiled."""
