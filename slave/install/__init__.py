"""Installer of a slave as a service on the machine that it runs on.

Standard library only: the system's Python runs it before there is anything else, also out of a zip file.
"""
