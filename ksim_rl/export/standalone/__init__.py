"""The source of `runner.py`, which runs without this library: `folder.runner_source` joins it."""
