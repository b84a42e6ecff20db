"""Set-up by a page: from an empty calibration folder to a tracked hand, each calibration as a wizard."""
