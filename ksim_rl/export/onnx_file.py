"""Writes programs of torch as ONNX files, without what the exporter adds about itself and this machine."""

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import Shaped
from torch import Tensor
from torch.export import ExportedProgram

OPSET = 18


@contextmanager
def quiet() -> Iterator[None]:
    """Silence the exporter's messages about its own workings."""
    # Both ways of speaking are closed: loggers and warnings.
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def write_onnx(
    program: ExportedProgram,
    examples: Sequence[Shaped[Tensor, "*?shape"]],
    path: Path,
    *,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> None:
    """Write a program with named inputs and outputs into one file, weights inside."""
    with torch.no_grad(), quiet():
        onnx = torch.onnx.export(
            program,
            args=tuple(examples),
            input_names=list(inputs),
            output_names=list(outputs),
            opset_version=OPSET,
            dynamo=True,
            optimize=False,
            verbose=False,
        )
        assert onnx is not None
        onnx.save(path)


def attach(path: Path, entries: Mapping[str, object]) -> None:
    """Put entries into an ONNX file that readers look for: numbers as text, lists with commas."""
    import onnx  # an extra

    # The weights are in the file: nothing is loaded from beside it.
    model = onnx.load(path, load_external_data=False)
    for written in (*model.graph.node, *model.graph.value_info):
        written.ClearField("metadata_props")  # what the exporter notes for itself, 20 kB
    for key, value in entries.items():
        entry = model.metadata_props.add()
        entry.key = key
        if isinstance(value, list):
            entry.value = ",".join(map(str, value))
        else:
            entry.value = str(value)
    onnx.save(model, path)
