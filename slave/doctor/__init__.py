"""Diagnosis of a device: its host and sensors enter, findings with a fix leave."""
