"""Turns dataclasses into plain trees and back, loads plug-ins, and stores the configs that Hydra finds."""
