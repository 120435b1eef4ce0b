"""Streams, graphs, keyed draws, running moments and trees of state, for all work on a device."""
