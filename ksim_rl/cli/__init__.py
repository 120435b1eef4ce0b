"""The command `ksim-rl`."""
