"""Observations are concatenated into the vectors that networks read by the transform of this module."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from ksim_rl import checks
from ksim_rl.transforms.checked_keys import CheckedKeys, as_keys
from ksim_rl.transforms.columns import side_by_side
from ksim_rl.transforms.row_transform import held_transforms
from ksim_rl.transforms.specs import (
    Device,
    bounded,
    bounds,
    check_no_picture,
    drop_leaf,
    leaf_spec,
    set_leaf_spec,
    spell,
)


@dataclass(frozen=True, kw_only=True)
class GroupSpec:
    """The map from terms, in order, to columns of one group vector, whose key is `name`."""

    name: NestedKey
    terms: tuple[NestedKey, ...]
    sizes: tuple[int, ...]
    """Numbers of columns."""

    @property
    def size(self) -> int:
        return sum(self.sizes)

    def slice(self, term: NestedKey) -> slice:
        """Return the columns of `term`, given by its key or by the last part of it."""
        # The whole key first: its last part may be the name of several terms.
        found = [i for i, key in enumerate(self.terms) if key == term] or [
            i for i, key in enumerate(self.terms) if last_name(key) == term
        ]
        if not found:
            raise checks.unknown_name(
                f"term of group {self.name!r}", str(term), map(last_name, self.terms)
            )
        if len(found) > 1:
            raise ValueError(
                f"group {self.name!r} has {len(found)} terms named {term!r}: give the whole key"
            )
        # Columns of the terms before it.
        start = sum(self.sizes[: found[0]])
        return slice(start, start + self.sizes[found[0]])

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for a checkpoint or an export: term name -> [start, stop)."""
        columns = {spell(key): self.slice(key) for key in self.terms}
        return {name: [found.start, found.stop] for name, found in columns.items()}


def last_name(key: NestedKey) -> str:
    """Return the last part of a key."""
    if isinstance(key, str):
        return key
    return str(key[-1])


class ObservationGroups(CheckedKeys):
    """Concatenate observations, each flattened per env, into one vector [E, L] per group, in the order of its terms.

    `drop` are keys to remove afterwards (all the terms for True), in the data and in the specs.

    Example:
        >>> groups = ObservationGroups({"actor": ["joint_pos", "joint_vel"], "critic": ["joint_pos", "height"]})
        >>> groups.slice("actor", "joint_vel")  # once an env holds it: the columns of a term
    """

    def __init__(
        self,
        groups: Mapping[NestedKey, Sequence[NestedKey]],
        *,
        drop: bool | Sequence[NestedKey] = False,
    ) -> None:
        if not groups:
            raise ValueError("groups={}: expected at least one group")
        self.groups = {name: as_keys(terms) for name, terms in groups.items()}
        for name, terms in self.groups.items():
            if not terms or len(set(terms)) != len(terms):
                raise ValueError(f"groups[{name!r}]={terms}: expected one or more distinct terms")
        # A term may be in several groups, but is read once.
        every = list(dict.fromkeys(term for terms in self.groups.values() for term in terms))
        super().__init__(every, list(self.groups), is_paired=False)
        # Terms of several groups are removed once.
        if drop is True:
            self.drop = every
        elif drop is False:
            self.drop = []
        else:
            self.drop = as_keys(drop)
        self.group_specs: dict[NestedKey, GroupSpec] = {}
        # Groups whose terms are known to be vectors [E, L] already.
        self._concatenable: set[NestedKey] = set()
        # Groups whose terms go nowhere else, so that their vector may lie where its terms do.
        shared = [term for terms in self.groups.values() for term in terms]
        self._owners = {
            name
            for name, terms in self.groups.items()
            if all(term in self.drop and shared.count(term) == 1 for term in terms)
        }

    def slice(self, group: NestedKey, term: NestedKey) -> slice:
        """Return the columns of a term in the vector of a group, once an env has asked for its specs."""
        if group not in self.groups:
            raise checks.unknown_name("group", str(group), map(str, self.groups))
        if group not in self.group_specs:
            raise RuntimeError(
                "the columns are known once an env holds the transform and has made its specs"
            )
        return self.group_specs[group].slice(term)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        batch_size = observation_spec.shape
        vectors = {}
        for name, terms in self.groups.items():
            if isinstance(observation_spec.get(name, None), Composite):
                raise ValueError(
                    f"group {name!r} would replace the observations under {name!r}: rename the group"
                )
            specs = [leaf_spec(observation_spec, term, type(self).__name__) for term in terms]
            for term, spec in zip(terms, specs, strict=True):
                check_no_picture(
                    term, spec, len(batch_size), "leave it alone, and read it by an encoder"
                )
            vectors[name] = self._vector_spec(specs, batch_size, observation_spec.device)
            # Vectors can be concatenated as they are; other shapes are flattened in each step.
            if all(spec.ndim == len(batch_size) + 1 for spec in specs):
                self._concatenable.add(name)
            else:
                self._concatenable.discard(name)
            sizes = tuple(spec.shape[len(batch_size) :].numel() for spec in specs)
            self.group_specs[name] = GroupSpec(name=name, terms=tuple(terms), sizes=sizes)
        for name, spec in vectors.items():
            set_leaf_spec(observation_spec, name, spec)
        for key in self.drop:
            drop_leaf(observation_spec, key)
        return observation_spec

    def _vector_spec(
        self, specs: list[TensorSpec], batch_size: torch.Size, device: Device
    ) -> TensorSpec:
        # The vector takes the dtype to which `torch.cat` promotes its terms.
        dtype = specs[0].dtype
        for spec in specs[1:]:
            dtype = torch.promote_types(dtype, spec.dtype)
        if not all(spec.dtype.is_floating_point for spec in specs):
            size = sum(spec.shape[len(batch_size) :].numel() for spec in specs)
            return Unbounded(torch.Size([*batch_size, size]), dtype=dtype, device=device)
        ends = [bounds(spec) for spec in specs]
        low = torch.cat([low.reshape(*batch_size, -1) for low, _ in ends], dim=-1)
        high = torch.cat([high.reshape(*batch_size, -1) for _, high in ends], dim=-1)
        return bounded(low, high, dtype=dtype, device=device)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        get = next_tensordict.get
        vectors = []
        for name, terms in self.groups.items():
            values = [get(term) for term in terms]
            if name not in self._concatenable:
                values = [value.reshape(*next_tensordict.batch_size, -1) for value in values]
            if name in self._owners and len(next_tensordict.batch_size) == 1:
                vectors.append(side_by_side(values, next_tensordict.batch_size[0]))
            else:
                vectors.append(torch.cat(values, -1) if len(values) > 1 else values[0])
        # Only now: a group may have the name of a term of another one.
        for name, vector in zip(self.groups, vectors):  # noqa: B905 (strict takes time in every step)
            next_tensordict.set(name, vector)
        for key in self.drop:
            drop_leaf(next_tensordict, key)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Do the same to a batch of samples."""
        self._check_samples(tensordict, is_floating=False)
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


def group_specs(env: EnvBase) -> dict[NestedKey, GroupSpec]:
    """Return which columns of each group's vector belong to which term, of all `ObservationGroups` of an env."""
    assert env.output_spec is not None  # making the specs is what counts the columns
    found: dict[NestedKey, GroupSpec] = {}
    for groups in held_transforms(env, ObservationGroups):
        # Transforms of outer envs come first, and hide groups of the same name inside.
        found = groups.group_specs | found
    return found


def observation_columns(env: EnvBase) -> dict[str, dict[str, list[int]]]:
    """Return `group_specs` as plain data for a checkpoint or an export: group -> term -> [start, stop)."""
    return {spell(name): spec.as_dict() for name, spec in group_specs(env).items()}
