"""The console: a page on the master's PC that shows, tunes, records and sets up. A process of its own."""
