"""Frozen recordings of messages with exact truth, and one solver against another on them."""
