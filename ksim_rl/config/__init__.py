"""Dataclasses to plain trees and back, the plug-ins of other packages, and the configs that Hydra finds."""
