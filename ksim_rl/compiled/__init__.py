"""This room makes few kernels of what torch computes for the rows of a batch: recorded, written in C++, replayed."""
