"""Camera drivers, one file each: settings enter, frames with times leave."""
