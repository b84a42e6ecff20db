"""What is not as it should be, from what all processes say: one list for people and programs (docs/checklist.md)."""
