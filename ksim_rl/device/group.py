"""Says which of several processes this one is, and which rows of their envs and draws are its own."""

import torch.distributed as dist


def size() -> int:
    """Return how many ranks train together."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_world_size()
    return 1


def rank() -> int:
    """Return which of the ranks this process is, from 0 on."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_rank()
    return 0


def first_row(num_rows: int) -> int:
    """Return the place of this rank's first row among the rows of all ranks, where each rank has `num_rows`."""
    return rank() * num_rows
