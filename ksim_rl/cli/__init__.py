"""This room is the command `ksim-rl`."""
