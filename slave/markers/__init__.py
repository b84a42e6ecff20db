"""Coloured markers in one image: classify, blobs, roi, detector."""
