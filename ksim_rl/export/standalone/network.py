"""Runs the ONNX files of an export, with the states that they carry from step to step."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ksim_rl.export.standalone.description import Export, StateSpec
from ksim_rl.export.standalone.files import Array, Json, check_count, read

# Types of the inputs that an export writes, by ONNX's names.
TYPES = {
    "tensor(float)": np.float32,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
    "tensor(uint8)": np.uint8,
}
MOST_NUMBERS = 2**26
"""Of one input: pictures of a history have the most."""


class Network:
    """An ONNX file, with the states that it carries from step to step."""

    def __init__(self, path: Path, states: list[StateSpec], output: str) -> None:
        # Here, so that a program that only reads signals needs no onnxruntime.
        import onnxruntime

        # As bytes: a path would let ONNX load further files from beside it.
        data = read(path)
        # The protobuf field of a tensor whose weights are in another file.
        if b"\x0a\x08location" in data:
            raise ValueError(f"{path}: weights outside of the file: expected all of them in it")
        # Episodes run in parallel processes; a small network gains nothing from threads.
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(
            data, options, providers=["CPUExecutionProvider"]
        )
        self.path = path
        self.specs = states
        self.outputs = [output, *(spec["output"] for spec in states)]
        self.inputs = {value.name: self._example(value) for value in self.session.get_inputs()}
        self.reset()

    def _example(self, value: Any) -> Array:
        """Return zeros of the shape and type of an input, for one robot."""
        shape = []
        for edge in value.shape:
            # A batch of any size has a name in place of a number.
            shape.append(1 if isinstance(edge, str) else edge)
        check_count(f"size of {value.name}", math.prod(shape), MOST_NUMBERS)
        return np.zeros(shape, TYPES[value.type])

    def reset(self) -> None:
        """Forget the episode."""
        self.states: list[Array] = []
        self.next_states: list[Array] = []

    def begin(self, feed: dict[str, Array]) -> list[Array]:
        """Return the states of a new episode: zeros, or its first frame in all places, or some columns of it."""
        states = []
        for spec in self.specs:
            example = self.inputs[spec["input"]]
            if spec.get("starts_with") != "frame":
                states.append(example)
                continue
            frame = feed[spec.get("of") or "obs"][:, None]
            columns = spec.get("columns")
            if columns is not None:
                frame = frame[..., slice(*columns)]
            states.append(np.repeat(frame, example.shape[1], 1))
        return states

    def run(self, given: dict[str, Array]) -> Array:
        """Return the first output, of one robot; after `advance` the next run reads the states that this one leaves."""
        feed = {}
        for name, value in given.items():
            example = self.inputs[name]
            feed[name] = np.asarray(value).reshape(example.shape).astype(example.dtype)
        if not self.states:
            self.states = self.begin(feed)
        # `states`, `specs` and the outputs after the first have the same order.
        feed |= {spec["input"]: state for spec, state in zip(self.specs, self.states, strict=True)}
        first, *self.next_states = (
            np.asarray(value) for value in self.session.run(self.outputs, feed)
        )
        return first[0].astype(np.float64)

    def advance(self) -> None:
        """End the step: the next run reads the states that the last run has written."""
        self.states = self.next_states


class Policy(Network):
    """The policy in `policy.onnx`."""

    def __init__(self, folder: Path, meta: Export) -> None:
        super().__init__(folder / "policy.onnx", meta["policy"]["states"], "actions")
        for spec in meta.get("pictures", []):
            self._check_picture(spec)

    def _check_picture(self, spec: Json) -> None:
        """Refuse a description of pictures with which `run` would reshape, or cast, them to other pictures."""
        name = spec["input"]
        if name not in self.inputs:
            raise ValueError(f"{self.path}: no input {name!r}: export.json has such pictures")
        example = self.inputs[name]
        shape = list(example.shape[1:])
        if spec["shape"] != shape or spec["dtype"] != example.dtype.name:
            raise ValueError(
                f"{self.path}: {name} is {example.dtype} {shape}: export.json has {spec['dtype']} {spec['shape']}"
            )

    def __call__(self, obs: Array, pictures: Mapping[str, Array]) -> Array:
        """Return the action [A] for the newest frame [L] and the newest pictures, by input."""
        given = dict(pictures)
        # A policy that only sees has no numbers.
        if "obs" in self.inputs:
            given["obs"] = obs
        action = self.run(given)
        self.advance()
        return action
