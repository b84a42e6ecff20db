"""Rigs of real processes on this machine: faults, attacks, many cameras, an hour."""
