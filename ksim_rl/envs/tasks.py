"""This door leads to the room `ksim_rl.tasks`: to the modules from which others of a kind are made."""

from ksim_rl.tasks import get_up, planar, velocity, velocity_training

__all__ = ["get_up", "planar", "velocity", "velocity_training"]
