"""Envs whose reward and flags lie in a nested TensorDict, as in TorchRL's multi-agent envs."""

from torchrl.data import Composite

from ksim_rl.testing import CounterEnv

SIGNALS = ("reward", "done", "terminated", "truncated")


def nested(env_class, observations=()):
    """Return a class of the same envs with ("agent", "reward"), ("agent", "done") ... and so the `observations`."""

    class Nested(env_class):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            for which in ("full_observation_spec", "full_reward_spec", "full_done_spec"):
                flat = getattr(self, which).clone()
                inner = {key: flat[key] for key in flat.keys() if key in (*SIGNALS, *observations)}
                outer = {key: flat[key] for key in flat.keys() if key not in inner}
                shared = {"shape": self.batch_size, "device": self.device}
                if inner:
                    outer["agent"] = Composite(inner, **shared)
                setattr(self, which, Composite(outer, **shared))

        def _step(self, tensordict):
            return self._nested(super()._step(tensordict))

        def _reset(self, tensordict=None, **kwargs):
            mask = None if tensordict is None else tensordict.get(("agent", "_reset"), None)
            if mask is not None:
                tensordict = tensordict.copy().set("_reset", mask)
            return self._nested(super()._reset(tensordict, **kwargs))

        def _nested(self, td):
            inner = td.select(*SIGNALS, *observations, strict=False)
            return td.exclude(*inner.keys()).set("agent", inner)

    return Nested


NestedSignals = nested(CounterEnv, ("count",))
