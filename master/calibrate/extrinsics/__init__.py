"""Extrinsics of a wrist device: one motion enters, its pose and latencies leave."""
