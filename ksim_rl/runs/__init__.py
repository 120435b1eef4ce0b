"""The record, metrics and curves of a run folder, and comparisons of runs."""
