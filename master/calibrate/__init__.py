"""Calibrations: pure fits, observations -> (value, residual), and the thin commands around them."""
