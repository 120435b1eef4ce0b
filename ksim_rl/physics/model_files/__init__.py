"""Finds the file of a model and turns it into a text that MuJoCo reads as its author meant it."""
