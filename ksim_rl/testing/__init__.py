"""Checks envs and data, for our tests and for yours: begin with `check_env(env)`."""

from ksim_rl.testing.check_env import check_env
from ksim_rl.testing.check_specs import assert_dims, assert_leaf
from ksim_rl.testing.counter_env import CounterEnv
from ksim_rl.testing.sync_count import SyncCount, count_syncs

__all__ = ["CounterEnv", "SyncCount", "assert_dims", "assert_leaf", "check_env", "count_syncs"]
