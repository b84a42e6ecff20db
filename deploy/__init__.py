"""Starts and orchestrates processes by their command lines; imports none of the packages it starts."""
