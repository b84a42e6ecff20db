"""Web console: messages of the bus enter, pages and commands leave."""
