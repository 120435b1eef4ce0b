"""This package is the physical scene: robots, objects, terrains, sensors, actuators, and the state that terms read."""
