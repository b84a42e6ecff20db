"""The card's line from centroids to fingers: FABRIK with hinges and rotors, each finger seeded in closed form."""
