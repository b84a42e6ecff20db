"""Simulated wrist device: a hand and its lights enter, camera pictures leave."""
