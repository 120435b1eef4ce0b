"""The device: streams, captured graphs, keyed random draws, running moments and trees of state."""
