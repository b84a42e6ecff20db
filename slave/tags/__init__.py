"""Fiducial tags (AprilTag, ArUco) on tracked objects."""
