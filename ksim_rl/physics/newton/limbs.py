"""This module finds the limbs of a kinematic tree: chains that hang from a trunk, between which M couples nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

# A lane keeps the factor of a limb, then that of the trunk, in its registers; larger ones take the dense Hessian.
MOST_OF_TRUNK = 10
MOST_OF_LIMB = 8
MOST_LIMBS = 15


@dataclass(frozen=True, kw_only=True)
class Limbs:
    """Degrees of freedom of the trunk, which has all below which something branches, and of each limb."""

    trunk: tuple[int, ...]
    chains: tuple[tuple[int, ...], ...]

    def tables(self, nv: int) -> dict[str, list[int]]:
        """Return, by degree of freedom, its slot, its limb (-1 in the trunk) and its place in a narrow row."""
        where = {dof: (-1, place) for place, dof in enumerate(self.trunk if self.chains else range(nv))}
        for limb, chain in enumerate(self.chains):
            where |= {dof: (limb, padded(len(self.trunk)) + place) for place, dof in enumerate(chain)}
        dofs, (limbs, places) = list(where), zip(*(where[dof] for dof in range(nv)), strict=True)
        slots = sorted(range(nv), key=dofs.__getitem__)
        return {"dofs": dofs, "slots": slots, "limbs": list(limbs), "places": list(places)}


def limbs_of(parents: Sequence[int]) -> Limbs:
    """Return the limbs of a tree, or nothing where there is one limb, or one part is too large."""
    leaves, chains = [0] * len(parents), dict[int, list[int]]()
    for dof in reversed(range(len(parents))):
        leaves[dof] = max(leaves[dof], 1)
        if parents[dof] >= 0:
            leaves[parents[dof]] += leaves[dof]
    for dof, parent in enumerate(parents):
        if leaves[dof] == 1:
            chains[dof] = [*chains.pop(parent, []), dof]
    trunk = tuple(dof for dof, count in enumerate(leaves) if count > 1)
    # The longest is the last, so that what a limb lacks of it are slots of others, of which it has no entries.
    limbs = tuple(sorted(map(tuple, chains.values()), key=len))
    suits = 1 < len(limbs) <= MOST_LIMBS and len(trunk) <= MOST_OF_TRUNK and len(limbs[-1]) <= MOST_OF_LIMB
    return Limbs(trunk=trunk, chains=limbs) if suits else Limbs(trunk=(), chains=())


def padded(count: int) -> int:
    """Return the next multiple of four: so many floats are loaded at once."""
    return 4 * -(-count // 4)
