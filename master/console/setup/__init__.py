"""Set-up by a page, from an empty calibration folder to a tracked hand.

Each calibration is a wizard.
"""
