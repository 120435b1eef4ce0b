"""Learned motor models on disk: weights as safetensors, what they mean in the file's metadata."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from ksim_rl.checks import near


@dataclass(frozen=True, kw_only=True)
class NetFile:
    """What a file holds.

    Attributes:
        where: path and SHA-256, for errors.
        tensors: float32, by name.
        metadata: text by name.
    """

    where: str
    tensors: dict[str, Tensor]
    metadata: dict[str, str]

    def tensor(self, name: str, *shape: int) -> Float[Tensor, "*shape"]:
        """Return a tensor of this shape, where -1 fits any size.

        Raises:
            ValueError: in one line, if it is missing, of another shape, or not finite.
        """
        if name not in self.tensors:
            raise ValueError(f"{self.where}: no tensor {name!r}: {near(name, self.tensors)}")
        tensor = self.tensors[name]
        fits = tensor.ndim == len(shape) and all(
            wanted in (-1, found) for wanted, found in zip(shape, tensor.shape, strict=True)
        )
        if not fits:
            wanted = ", ".join("any" if size == -1 else str(size) for size in shape)
            raise ValueError(f"{self.where}: {name} has shape {tuple(tensor.shape)}: expected ({wanted})")
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{self.where}: {name} holds numbers that are not finite")
        return tensor

    def check_all_known(self, names: set[str]) -> None:
        """Refuse tensors that the net would not use.

        Raises:
            ValueError: naming them.
        """
        unknown = sorted(self.tensors.keys() - names)
        if unknown:
            raise ValueError(f"{self.where}: unknown tensors {unknown}: expected {sorted(names)}")


def read_net_file(file: str, sha256: str | None) -> NetFile:
    """Read a safetensors file; nothing in it is ever executed.

    Args:
        file: its path; `~` is the home folder.
        sha256: what its bytes must hash to (hexadecimal), or None.

    Raises:
        ValueError: in one line with the path and the hash, if the file is missing, damaged or another one.
    """
    path = Path(file).expanduser()
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"file={file!r}: {error.strerror or error}: expected a safetensors file") from None
    digest = hashlib.sha256(data).hexdigest()
    where = f"file={file!r} (SHA-256 {digest})"
    if sha256 is not None and digest != sha256.lower():
        raise ValueError(f"{where}: expected sha256={sha256!r}: the file is damaged, or another one")
    try:
        tensors = load(data)
    except SafetensorError as error:
        raise ValueError(f"{where}: no safetensors file: {' '.join(str(error).split())}") from None
    # The header: its length in 8 bytes, then JSON (https://github.com/huggingface/safetensors#format).
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    return NetFile(
        where=where,
        tensors={name: tensor.to(torch.float32) for name, tensor in tensors.items()},
        metadata=header.get("__metadata__", {}),
    )
