"""The commands of `phalanx-slave`: their table, and their options as text; what does the work is loaded when called."""
