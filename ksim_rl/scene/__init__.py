"""The physical scene: robots, objects, terrains, sensors, actuators, and the state that terms read."""
