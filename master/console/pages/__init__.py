"""Pages of the console, one file each.

`build(state)` fills the shell of `master.console.app`.
"""
