"""Tracked objects: pictures or measures enter, printed sheets and files leave."""
