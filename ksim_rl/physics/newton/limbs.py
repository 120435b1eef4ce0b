"""Finds the limbs of a kinematic tree: chains that hang from a trunk, between which M couples nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

# A lane keeps the factor of a limb, then the trunk's, in its registers; larger ones take the dense Hessian.
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
        # Where nothing branches, all are of the trunk.
        trunk = self.trunk if self.chains else range(nv)
        where = {dof: (-1, place) for place, dof in enumerate(trunk)}
        for limb, chain in enumerate(self.chains):
            where |= {
                dof: (limb, padded(len(self.trunk)) + place) for place, dof in enumerate(chain)
            }
        dofs = list(where)
        (limbs, places) = zip(*(where[dof] for dof in range(nv)), strict=True)
        slots = sorted(range(nv), key=dofs.__getitem__)
        return {"dofs": dofs, "slots": slots, "limbs": list(limbs), "places": list(places)}


def limbs_of(parents: Sequence[int]) -> Limbs:
    """Return the limbs of a tree, or nothing where there is one limb, a part is too large, or no row gets narrower."""
    # The leaves at or below each degree of freedom: with more than one, it belongs to the trunk.
    leaves = [0] * len(parents)
    chains = dict[int, list[int]]()
    # Children come after their parents, so that the reverse order meets them first.
    for dof in reversed(range(len(parents))):
        leaves[dof] = max(leaves[dof], 1)
        if parents[dof] >= 0:
            leaves[parents[dof]] += leaves[dof]
    # A chain is taken over by its next degree of freedom, until it ends in a leaf.
    for dof, parent in enumerate(parents):
        if leaves[dof] == 1:
            chains[dof] = [*chains.pop(parent, []), dof]
    trunk = tuple(dof for dof, count in enumerate(leaves) if count > 1)
    # The longest is the last, so that what a limb lacks of it are slots of others, of which it has no entries.
    limbs = tuple(sorted(map(tuple, chains.values()), key=len))
    found = Limbs(trunk=trunk, chains=limbs)
    if _suits(found, nv=len(parents)):
        return found
    return Limbs(trunk=(), chains=())


def _suits(limbs: Limbs, *, nv: int) -> bool:
    """Whether the solver gains by these limbs: each fits a lane's registers, and narrow rows are not the wider ones."""
    if not 1 < len(limbs.chains) <= MOST_LIMBS:
        return False
    longest = len(limbs.chains[-1])
    if len(limbs.trunk) > MOST_OF_TRUNK or longest > MOST_OF_LIMB:
        return False
    # In a small tree, such as a cart with two poles, padding makes the narrow row the wider one.
    narrow = row_stride(padded(len(limbs.trunk)) + longest)
    return narrow <= row_stride(nv)


def row_stride(entries: int) -> int:
    """Return the floats from one row of so many entries to the next in shared memory.

    Rows are whole groups of four floats, which are loaded together. The number of groups is odd, so that the rows of
    neighbouring lanes begin in other banks of shared memory.
    """
    groups = -(-entries // 4)
    return 4 * (groups | 1)


def padded(count: int) -> int:
    """Return the next multiple of four: so many floats are loaded together."""
    return 4 * -(-count // 4)
