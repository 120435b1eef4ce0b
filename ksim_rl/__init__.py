"""TorchRL components for training robot policies in MuJoCo on the GPU."""

__version__ = "0.2.0"
