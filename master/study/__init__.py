"""Repeat the user study of Digits (Kim et al. 2012) with simulated people.

Twelve people, six poses, three blocks; open loop.
"""
