"""Import of videos and pictures of foreign cameras as a recording.

It finds which camera they belong to and when they were taken.
"""
