"""One hand from several sensors at once: marker rigs, the wrist device, and the IMU on its forearm."""
