"""Makes the table of docs/reliability.md that says how models fared beside MuJoCo's C engine."""

from collections.abc import Mapping
from typing import Any

from benchmarks.pages.table import table

DEVICES = ("cpu", "h200")
# What is shown of each device, by the name of its figure.
ROWS = {
    "generated/models": "generated models that were built and stepped",
    "generated/states": "states of their worlds that were compared",
    "generated/refused": "generated models that were refused by name",
    "generated/worse": "**generated models that differ from C**",
    "generated/least_of_a_feature": "least models of a feature, among those that ran",
    "generated/touching_share": "share of them with contacts",
    "generated/accepted_states": "states judged by the depths of contacts alone",
    "generated/unsteady_states": "states that C itself does not come through",
    "generated/by_our_kernels": "models that ran by our kernels alone",
    "generated/by_our_solver": "models that ran by our solver, and MuJoCo Warp's kernels",
    "generated/by_mujoco_warp": "models that ran by MuJoCo Warp's kernels alone",
    "generated/compiled_worlds": "worlds compared with what C compiles from XML with their fields",
    "generated/resets": "models whose masked resets are new worlds, bit for bit",
    "generated/short_of_room": "models that ran with too little room, too, and had to say so",
    "registered/models": "models of registered tasks and robot files",
    "registered/states": "states of their worlds that were compared",
    "registered/worse": "**models of these that differ from C**",
}


def text(saved: Mapping[str, Any]) -> str:
    """The figures of the judge, and why models were refused; what was not measured is a dash."""
    figures = saved.get("figures", {})
    rows = []
    for name, words in ROWS.items():
        rows.append([words, *(_cell(figures.get(f"{device}/{name}")) for device in DEVICES)])
    shown = table(["", "CPU", "H200"], rows)
    return f"{shown}\n\n{refusals(saved.get('generated_refused', {}))}"


def refusals(reasons: Mapping[str, Mapping[str, int]]) -> str:
    """Return a line for each reason why models of the first device that was measured were refused."""
    measured = [
        reasons[f"{device}/generated"] for device in DEVICES if f"{device}/generated" in reasons
    ]
    if not measured:
        return "No model was refused."
    lines = ["Refused, by what the message says without names:", ""]
    for reason, count in measured[0].items():
        lines.append(f"* {count}: `{reason.strip()}`")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.2g}"
