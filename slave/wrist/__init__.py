"""Wrist camera: strobed images enter, laser and fingertip points leave."""
