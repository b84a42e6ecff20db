"""Offline solving: recorded frames or detections enter, the same poses leave."""
