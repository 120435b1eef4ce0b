"""Lets several processes train together: each is a rank with its own envs, started by torchrun, one per GPU.

All numbers are drawn by an env's place among the envs of all ranks, means are over all ranks, and rank 0 writes. A
process that was not started so is one of one, for which nothing here does anything.
"""

from ksim_rl.device.group import first_row, rank, size
from ksim_rl.ranks.draws import exponential, rand, randint, randn
from ksim_rl.ranks.heartbeat import at
from ksim_rl.ranks.reduce import any_of, combined, gather, mean_, merged, most_of, sum_
from ksim_rl.ranks.shards import dealt, gathered, share_of
from ksim_rl.ranks.start import by_first, check_same, device, joined, restarted, run_folder
from ksim_rl.ranks.timing import Timing
