"""TorchRL components for training robot policies in MuJoCo on the GPU."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("ksim_rl")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"
