"""Devices that track themselves, such as a Vive tracker.

One interface, one file per driver.
"""
