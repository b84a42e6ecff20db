"""Objects that are tracked: what is printed for them, and their files."""
