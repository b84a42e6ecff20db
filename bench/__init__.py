"""Speed and accuracy, measured: every row against a baseline or an exact truth of the same run."""
