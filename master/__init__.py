"""On the PC: messages in, hands out."""
