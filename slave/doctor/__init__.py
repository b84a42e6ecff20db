"""`phalanx-slave doctor`: diagnosis of a device.

It reports what is well, what is not, and how to mend that. It changes nothing.
"""
