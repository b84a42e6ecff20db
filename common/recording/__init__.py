"""Recordings on disk: messages and frames enter, and leave exactly as they were."""
