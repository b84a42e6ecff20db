"""What is measured of a wrist device: laser plane, light of the LEDs, the palm before it, how each finger curls."""
