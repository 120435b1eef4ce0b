"""Runs the network of an exported policy, with the states that it carries from step to step."""

from pathlib import Path

import numpy as np

from ksim_rl.export.standalone.files import Array, Json, read


class Policy:
    """The policy in `policy.onnx`, with the states that it carries from step to step."""

    def __init__(self, folder: Path, meta: Json) -> None:
        # Here, so that a program that only reads signals needs no onnxruntime.
        import onnxruntime

        # As bytes: a path would let ONNX load further files from beside it.
        data = read(folder / "policy.onnx")
        # The protobuf field by which a tensor keeps its weights in another file.
        if b"\x0a\x08location" in data:
            raise ValueError(
                f"{folder / 'policy.onnx'}: weights outside of the file: expected all of them in it"
            )
        # Episodes run in parallel processes; a small network gains nothing from threads.
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
        # ONNX holds float32, with a batch of one in front.
        frame = np.asarray(obs, np.float32)[None]
        # The first call of an episode: memories begin as zeros, or as the first frame in all places.
        if not self.states:
            self.states = [
                np.zeros((1, *spec["shape"]), np.float32)
                if spec["starts_with"] == "zeros"
                else np.repeat(frame[:, None, slice(*spec["columns"])], spec["shape"][0], 1)
                for spec in self.specs
            ]
        # `states`, `specs` and the outputs after the actions have the same order.
        feed = {"obs": frame} | {s["input"]: v for s, v in zip(self.specs, self.states, strict=True)}
        actions, *self.states = (np.asarray(value) for value in self.session.run(self.outputs, feed))
        return actions[0].astype(np.float64)
