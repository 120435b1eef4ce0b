"""Identifies the parameters of a robot's joints from a log of commands and encoders, and proposes the commands."""
