"""On the PC: messages enter, hands leave."""
