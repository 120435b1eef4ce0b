"""Fuses recorded torch operations that act per env into a few C++ kernels, and replays them."""
