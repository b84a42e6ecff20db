"""Export of recorded hands to the file formats of other programs.

The formats are tables, motion capture, animated meshes and Rerun.
"""
