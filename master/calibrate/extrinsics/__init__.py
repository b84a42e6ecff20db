"""Extrinsics of a wrist device on its forearm, and the latency of its clocks.

Estimated from a motion that both marker rig and device see.
"""
