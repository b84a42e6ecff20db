"""The table of commands and their options: words enter, parsed options leave."""
