"""Calibrations: recordings or live messages enter, files of calib_json leave."""
