"""This module asserts dim names, for unit tests that say what shape a datum has."""

from tensordict import TensorDictBase


def assert_dims(td: TensorDictBase, *names: str) -> None:
    """Check that the batch dims of `td`, and of each tensordict inside, bear `names`.

    Example:
        >>> assert_dims(env.rollout(8), "E", "T")
        >>> assert_dims(dataset.sample(), "B")

    Raises:
        AssertionError: with the path, the names found and the names expected.
    """
    _assert_dims(td, list(names), "the tensordict")


def assert_leaf(td: TensorDictBase, key: str | tuple[str, ...], *leaf_shape: int) -> None:
    """Check the shape of a leaf beyond the batch dims: `assert_leaf(rollout_ET, "actor", 48)` for [E, T, 48].

    Raises:
        AssertionError: with both shapes.
    """
    found = tuple(td[key].shape[td.batch_dims :])
    assert found == leaf_shape, f"{key!r} has shape {found} beyond {td.names}: expected {leaf_shape}"


def _assert_dims(td: TensorDictBase, names: list[str], where: str) -> None:
    assert td.names[: len(names)] == names and td.batch_dims >= len(names), (
        f"{where} has dims {td.names} (batch size {tuple(td.batch_size)}): expected {names}"
    )
    if where == "the tensordict":
        assert td.batch_dims == len(names), f"{where} has dims {td.names}: expected exactly {names}"
    for key, value in td.items():
        if isinstance(value, TensorDictBase):
            _assert_dims(value, names, f"{where}[{key!r}]")
