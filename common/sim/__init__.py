"""A rig without hardware: motions with exact truth, and the images a camera would take of them."""
