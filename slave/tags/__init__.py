"""Fiducial tags (AprilTag, ArUco): an image enters, corners leave."""
