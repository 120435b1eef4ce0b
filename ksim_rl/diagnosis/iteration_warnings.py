"""Names the losses of one iteration, from its metrics, so that a run can tell them immediately."""

from collections.abc import Mapping, Sequence


def warnings_of(losses: Sequence[str], metrics: Mapping[str, float]) -> dict[str, str]:
    """Return the faults, by kind: `losses` are contacts or constraints that physics had no room for."""
    texts = {
        text.split(":")[0].split(" needed")[0]: f"PHYSICS LOST CONTACTS OR CONSTRAINTS: {text}"
        for text in losses
    }
    if failed := metrics.get("sum/termination/non_finite"):
        texts["non_finite"] = (
            f"{failed:.0f} envs ended with non-finite physics or actions; they were reset"
        )
    if skipped := metrics["update/skipped_steps"]:
        texts["skipped"] = f"{skipped:.0f} gradient steps were not finite and were skipped"
    return texts
