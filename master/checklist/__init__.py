"""Checklist of a rig: what all processes report enters, problems and fixes leave."""
