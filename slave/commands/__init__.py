"""What `phalanx-slave` can be asked, a file for each command: purpose and examples, its options, what it does."""
