"""A run against exact truth: poses and truth enter, errors and pictures leave."""
