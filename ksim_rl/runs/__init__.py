"""This room holds what is in a run folder beside checkpoints: how it came about, how it goes, and how runs compare."""
