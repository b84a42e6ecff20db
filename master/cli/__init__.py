"""The commands of `phalanx`: their table, and their options as text; what does the work is loaded when called."""
