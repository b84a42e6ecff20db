"""Instructions of the slave per frame on aarch64, counted under emulation; see docs/instructions.md."""
