"""Commands of `phalanx-slave`, one file each.

Each file has purpose and examples, its options, and what it does.
"""
