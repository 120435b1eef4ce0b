"""Joins exported policies of ksim_rl to Unitree's robots over DDS."""
