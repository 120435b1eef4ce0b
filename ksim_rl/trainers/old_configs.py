"""This module brings the configs that runs of earlier versions left up to date."""

from collections.abc import Mapping
from typing import Any

# Up to 0.1 an objective without a class was this one.
OBJECTIVE_OF_0_1 = "ksim_rl.objectives.PPOCfg"


def up_to_date(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config tree of a run as this version writes it."""
    tree = dict(tree)
    objective = tree.get("objective")
    if isinstance(objective, Mapping) and "_target_" not in objective:
        tree["objective"] = {"_target_": OBJECTIVE_OF_0_1, **objective}
    return tree
