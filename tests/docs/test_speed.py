"""The figures in README and docs/speed.md agree with benchmarks/results."""

import json
from typing import Any

import pytest

from benchmarks import report
from tests.docs.guide import DOCS, REPOSITORY

README = (REPOSITORY / "README.md").read_text()
PAGE = (DOCS / "speed.md").read_text()
NOTE = (DOCS / "notes" / "speed.md").read_text()
GO1, G1 = "h200/go1_velocity_flat/4096/", "h200/g1_velocity_flat/4096/"
MEMORY = ("physics", "env_and_rollout", "update")
ROOMS = ("physics", "terms", "update", "refresh", "resets", "policy")


def results(name: str) -> Any:
    return json.loads((report.RESULTS / f"{name}.json").read_text())["figures"]


def in_rooms(prefix: str, figure: str) -> str:
    """Return the cells of the profile's rooms; before, the step was not compiled, and terms were in three of them."""
    profile = results("profile")
    rooms = [("terms", "transforms", "rollout") if room == "terms" else (room,) for room in ROOMS]
    found = [
        sum(profile.get(f"{prefix}{own}_{figure}", 0) for own in together) for together in rooms
    ]
    return " | ".join(
        f"{value:,.0f}" if figure == "kernels" else f"{100 * value:.0f} %" for value in found
    )


def said() -> dict[str, tuple[str, str]]:
    """By what is said: the page, and the words, with the figures that they have to hold."""
    speed, peers = results("throughput"), results("peers")
    learning, scaling = results("learning_time"), results("scaling")
    collector, update = results("collector"), results("update")
    transforms = results("transforms")
    memory = [round(speed[f"{GO1}{part}_bytes_per_world"] / 1000) for part in MEMORY]
    return {
        "first": (
            README,
            f"trains at {speed[GO1 + 'env_states_per_s'] / 1e6:.2f} million env states",
        ),
        "scaling": (
            PAGE,
            f"{scaling['h200/go1_velocity_flat/32768/env_states_per_s'] / 1e6:.2f} million env states per second",
        ),
        "g1 scaling": (
            PAGE,
            f"and G1 at {scaling['h200/g1_velocity_flat/32768/env_states_per_s'] / 1e6:.2f} million, "
            f"{scaling['h200/g1_velocity_flat/32768/iteration_over_physics']:.1f} times",
        ),
        "h100": (
            PAGE,
            f"Go1 at {speed['h100/go1_velocity_flat/4096/env_states_per_s'] / 1e6:.2f} million env states per "
            "second with 4096 envs and at "
            f"{scaling['h100/go1_velocity_flat/32768/env_states_per_s'] / 1e6:.2f} million with 32768, and G1 at "
            f"{scaling['h100/g1_velocity_flat/32768/env_states_per_s'] / 1e6:.2f} million",
        ),
        "g1": (PAGE, f"trains at {round(speed[G1 + 'env_states_per_s'], -3):,.0f} with 4096"),
        "g1 substeps": (PAGE, f"its own substeps take {speed[G1 + 'own_physics_ms']:.2f} ms"),
        "kernels": (PAGE, f"is {speed[GO1 + 'kernels_per_control_step']:.0f} kernels"),
        "g1 physics": (PAGE, f"{speed[G1 + 'iteration_over_physics']:.2f} times its raw physics"),
        "peers": (
            PAGE,
            f"{peers[GO1 + 'over_peer']:.1f} times slower on Go1, {peers[G1 + 'over_peer']:.1f} times on G1",
        ),
        "learning": (PAGE, f"**{learning['seconds_to_track']:.0f} s**"),
        "first iteration": (
            PAGE,
            f"takes {speed[GO1 + 'first_iteration_warm_s']:.1f} s, or {speed[GO1 + 'first_iteration_cold_s']:.0f} s",
        ),
        "memory": (PAGE, " kB, ".join(map(str, memory)) + " kB"),
        "switch": (
            PAGE,
            f"of Go1 is {results('determinism')['h200/go1_velocity_flat/on_over_off']:.3f} times as fast with it",
        ),
        "guards": (PAGE, f"{100 * speed[GO1 + 'guards_share']:.1f} % of an iteration"),
        "chain": (
            PAGE,
            f"+ {100 * transforms['h200/4096/chain_share_of_go1_step']:.1f} % of a control step",
        ),
        "randomization": (
            PAGE,
            f"+ {100 * results('randomization')[GO1 + 'reset_share']:.1f} % of a control step",
        ),
        "terrain": (PAGE, f"x {results('terrain')['rough_over_flat']:.2f}"),
        "profile": (PAGE, f"| share | {in_rooms(GO1, 'share')} |"),
        "kernels of the profile": (PAGE, f"| kernels | {in_rooms(GO1, 'kernels')} |"),
        "profile before": (NOTE, f"| share | {in_rooms(f'{GO1}before/', 'share')} |"),
        "kernels before": (NOTE, f"| kernels | {in_rooms(f'{GO1}before/', 'kernels')} |"),
        "collector": (PAGE, f"x {collector['h200/cartpole/4096/captured_over_stock']:.1f} |"),
        "its graphs": (
            PAGE,
            f"x {collector['h200/cartpole/4096/captured_over_stock_with_graphs']:.1f} |",
        ),
        "update": (PAGE, f"x {update['h200/98304/stock_eager_over_update']:.1f} |"),
    }


@pytest.mark.parametrize("what", said())
def test_a_figure_in_the_text(what: str) -> None:
    page, words = said()[what]
    assert words in " ".join(page.split()), (
        f"{words!r} is not there: the results have changed, or the text"
    )
