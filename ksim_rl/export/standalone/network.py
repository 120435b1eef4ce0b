"""Runs the network of an exported policy, with what it carries from step to step."""

from pathlib import Path
from typing import Any

import numpy as np

from ksim_rl.export.standalone.files import Array, read


class Policy:
    """The policy in `policy.onnx`, with what it carries from step to step."""

    def __init__(self, folder: Path, meta: dict[str, Any]) -> None:
        import onnxruntime

        data = read(folder / "policy.onnx")
        if b"\x0a\x08location" in data:
            raise ValueError(
                f"{folder / 'policy.onnx'}: weights outside of the file: expected all of them in it"
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        self.specs = meta["policy"]["states"]
        self.states: list[Array] = []
        self.outputs = ["actions", *(spec["output"] for spec in self.specs)]

    def reset(self) -> None:
        """Forget the episode."""
        self.states = []

    def __call__(self, obs: Array) -> Array:
        """Return the action [A] for the newest frame [L]."""
        frame = np.asarray(obs, np.float32)[None]
        if not self.states:
            self.states = [
                np.zeros((1, *spec["shape"]), np.float32)
                if spec["starts_with"] == "zeros"
                else np.repeat(frame[:, None, slice(*spec["columns"])], spec["shape"][0], 1)
                for spec in self.specs
            ]
        feed = {"obs": frame} | {s["input"]: v for s, v in zip(self.specs, self.states, strict=True)}
        actions, *self.states = (np.asarray(value) for value in self.session.run(self.outputs, feed))
        return actions[0].astype(np.float64)
