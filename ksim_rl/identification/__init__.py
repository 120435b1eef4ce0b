"""Finds the numbers of a robot's joints in a log of its commands and encoders, and proposes what to log."""
