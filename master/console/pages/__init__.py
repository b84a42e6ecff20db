"""Pages of the console, one file each: its state enters, elements leave."""
