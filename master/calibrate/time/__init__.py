"""Latency of cameras: tracks of a moving hand enter, delays leave."""
