"""Recorded hands as files of other programs: tables, motion capture, animated meshes, Rerun."""
