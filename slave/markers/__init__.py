"""Coloured markers: an image enters; classes, blobs, ROI; centroids leave."""
