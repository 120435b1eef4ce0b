import time

from benchmarks import command_line
from benchmarks.profile import Clock, Live, by_room, measure
from ksim_rl.device.capture import Captured


def test_a_room_is_charged_without_the_rooms_inside_it():
    clock = Clock()
    clock.run("outer", lambda: clock.run("inner", lambda: time.sleep(0.05)))
    assert clock.seconds["inner"] >= 0.05
    assert clock.seconds["outer"] < clock.seconds["inner"]


def test_kernels_go_to_the_innermost_room_that_launched_them():
    def span(name, begin, end):
        return {"name": f"room:{name}", "cat": "user_annotation", "ts": begin, "dur": end - begin}

    def kernel(correlation, at, us, name="k"):
        launch = {
            "name": "cudaLaunchKernel",
            "cat": "cuda_runtime",
            "ts": at,
            "args": {"correlation": correlation},
        }
        return [
            launch,
            {
                "name": name,
                "cat": "kernel",
                "ts": 900,
                "dur": us,
                "args": {"correlation": correlation},
            },
        ]

    events = [span("update", 0, 100), span("physics", 10, 20)]
    events += (
        kernel(1, 15, 3.0)
        + kernel(2, 50, 5.0)
        + kernel(3, 60, 7.0, "estimate_advantages")
        + kernel(4, 200, 1.0)
    )
    assert by_room(events) == {
        "physics": (1, 3.0),
        "update": (1, 5.0),
        "gae": (1, 7.0),
        "other": (1, 1.0),
    }


def test_an_iteration_of_a_compiled_step_is_laid_to_its_rooms():
    fixed = (
        "device=cpu",
        "num_envs=64",
        "logger=none",
        "trainer.eval_episodes=0",
        "collector.compile=true",
    )
    figures = measure(command_line.compose(["task=pendulum_swingup", *fixed]))
    shares = {name: value for name, value in figures.items() if name.endswith("_share")}
    rooms = {"physics", "refresh", "resets", "terms", "policy", "storage", "update", "log"}
    assert shares.keys() == {f"{room}_share" for room in rooms}
    assert min(shares.values()) > 0.0 and abs(sum(shares.values()) - 1.0) < 1e-6
    assert figures["terms_ms"] < figures["iteration_ms"] / 2, (
        "what is inside is not taken out of the rollout"
    )


def test_what_is_profiled_runs_each_time_where_the_captured_does():
    calls = []
    captured = Captured(lambda: calls.append(1), device="cpu")
    live = Live(captured)
    live()
    live()
    assert len(calls) == 2 and live.device == captured.device
