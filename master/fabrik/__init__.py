"""The card's line: centroids enter; depth, 1 € filter, FABRIK; a hand leaves."""
