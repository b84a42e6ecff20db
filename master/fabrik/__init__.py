"""FABRIK with joint limits, each finger seeded in closed form."""
