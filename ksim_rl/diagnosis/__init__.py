"""Finds faults: in how a run learns, by the metrics that it logs, and in the machine that it runs on."""
