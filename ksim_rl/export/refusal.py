"""The error for parts of a task that an export cannot write down."""


class NotDescribedError(ValueError):
    """A part of a task that cannot be written down for other programs; its message names the part and the way out."""
