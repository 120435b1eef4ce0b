"""The tasks, one module each; `ksim_rl.envs.registry` finds the `Task`s that they hold."""
