"""What commands of a slave do: parsed options enter, lines and codes leave."""
