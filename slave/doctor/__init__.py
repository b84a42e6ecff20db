"""`phalanx-slave doctor`: what of a device is well, what is not, and how that is mended. It changes nothing."""
