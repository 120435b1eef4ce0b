"""A CounterEnv whose observations, reward and flags lie in a TensorDict of their own, as those of agents do."""

from torchrl.data import Composite

from ksim_rl.testing import CounterEnv


class NestedSignals(CounterEnv):
    """The EnvStates of a CounterEnv, with ("agent", "count"), ("agent", "reward"), ("agent", "done") and so on."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        for which in ("full_observation_spec", "full_reward_spec", "full_done_spec"):
            flat = getattr(self, which).clone()
            setattr(self, which, Composite(agent=flat, shape=self.batch_size, device=self.device))

    def _step(self, tensordict):
        return self._nested(super()._step(tensordict))

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get(("agent", "_reset"), None)
        if mask is not None:
            tensordict = tensordict.copy().set("_reset", mask)
        return self._nested(super()._reset(tensordict, **kwargs))

    def _nested(self, td):
        return td.empty().set("agent", td)
