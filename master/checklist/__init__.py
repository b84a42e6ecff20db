"""Checklist of current problems, from what all processes report.

One list for people and programs (docs/checklist.md).
"""
