"""This package holds what work on a device shares: streams, graphs, keyed draws, moments and trees of state."""
