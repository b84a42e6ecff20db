"""What commands of the PC do: parsed options enter, lines and exit codes leave."""
