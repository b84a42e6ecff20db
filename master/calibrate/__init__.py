"""Calibrations: pure fits and the thin commands around them.

A fit maps observations -> (value, residual).
"""
