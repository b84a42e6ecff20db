"""Sinks: hands, objects and gestures enter; files, pictures, Rerun and bus leave."""
