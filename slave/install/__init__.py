"""Installer of a slave: a plan enters, a running service leaves, or nothing."""
