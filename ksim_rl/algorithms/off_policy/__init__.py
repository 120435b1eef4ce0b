"""The update, wiring and replays that the off-policy algorithms share."""

from ksim_rl.data import ReplayCfg

# An iteration is num_steps steps of each env and then num_minibatches gradient steps. For many envs on a GPU:
MANY_ENVS = ReplayCfg(num_env_states_per_minibatch=32768, num_minibatches=16, num_steps=4)
# For few envs: small minibatches, and one gradient step for some env states.
FEW_ENVS = ReplayCfg(
    num_env_states_per_minibatch=256,
    num_minibatches=16,
    num_steps=16,
    capacity=20000,
    learning_starts=100,
)
