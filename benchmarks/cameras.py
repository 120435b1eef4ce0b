"""Times pictures: drawn alone, in a rollout, and in training.

    python -m benchmarks.cameras device=cuda

gives each task one camera, whose picture the policy reads by an encoder beside what it always reads; the critic sees
none. `tasks`, `num_envs`, `sizes` (pixels of a side) and `outputs` (rgb, depth) choose a part, as lists between commas;
other words are overrides of `ksim-rl train`, for all. The figures of each combination:

* `renderer_frames_per_s`: MuJoCo Warp's renderer alone, one graph of its own two calls, from states of this run;
* `drawn_frames_per_s`: the same states as a term reads them, with the copy of the picture;
* `rollout_frames_per_s` and `training_frames_per_s`: frames of one rollout, and of one iteration with its update;
* `renderer_bytes_per_env`, `rollout_bytes_per_env`: what the renderer holds of each env, and one rollout; on CUDA
  `torch_bytes_per_env`: all that torch has taken after training.

They go to benchmarks/results/cameras.json as `<device>/<task>/<num_envs>/<size>/<figure>`; names of depth figures begin
with `depth_`. docs/vision.md says what they mean.
"""

from __future__ import annotations

import gc
import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import mujoco_warp as mjw
import torch
import warp as wp
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.raw_physics import as_graph
from benchmarks.stopwatch import milliseconds
from benchmarks.throughput import SCHEDULES, iteration_ms, num_env_states
from ksim_rl import mdp
from ksim_rl.checks import check_choice
from ksim_rl.device.capture import Captured
from ksim_rl.device.streams import warp_scope
from ksim_rl.modules import EncoderCfg
from ksim_rl.physics.ray_casting import BatchCamera
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.scene.sensors import CameraSensor
from ksim_rl.trainers import RunCfg, Trainer, build
from ksim_rl.transforms.groups.group_cfg import ObservationGroupCfg, ObservationTermCfg

NAME = "cameras"
CAMERA = "camera"
Output = Literal["rgb", "depth"]
OUTPUTS: tuple[Output, ...] = ("rgb", "depth")
# Forward and 30 degrees down, right and up in the frame of a body whose x points forward.
AHEAD = (0.0, -1.0, 0.0, 0.5, 0.0, 0.866)
# The same, 75 degrees down.
AT_THE_FEET = (0.0, -1.0, 0.0, 0.966, 0.0, 0.259)
CAMERAS = {
    "cartpole_balance": CameraSensor(pos=(0.0, -3.0, 1.0), xyaxes=(1.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    # The floor, and the primitives with which this robot collides.
    "go1_velocity_flat": CameraSensor(
        body="trunk", pos=(0.3, 0.0, 0.05), xyaxes=AHEAD, geom_groups=(0, 3)
    ),
    # The floor, and the capsules of arms and legs: models for training have no meshes that only show.
    "g1_velocity_flat": CameraSensor(
        body="torso_link", pos=(0.2, 0.0, 0.4), xyaxes=AT_THE_FEET, fovy=90.0, geom_groups=(0, 3)
    ),
    # In front of the table, as high as the arm.
    "panda_pick_cube": CameraSensor(pos=(1.8, 0.0, 0.8), xyaxes=(0.0, 1.0, 0.0, -0.3, 0.0, 0.954)),
}
OWN_OPTIONS = {
    "tasks": ",".join(CAMERAS),
    "num_envs": "4096,1024",
    "sizes": "64,128",
    "outputs": ",".join(OUTPUTS),
}
SPEEDS = ("renderer", "drawn", "rollout", "training")


def with_camera(cfg: RunCfg, task: str, *, size: int, output: Output) -> RunCfg:
    """Return a run whose policy reads pictures of `size` x `size` pixels beside what it reads."""
    sensor = replace(
        CAMERAS[task],
        width=size,
        height=size,
        rgb=output == "rgb",
        depth=output == "depth",
    )
    picture = ObservationTermCfg(term=mdp.CameraImage(sensor=CAMERA, output=output))
    scene = cfg.task.scene
    task_cfg = replace(
        cfg.task,
        scene=replace(scene, sensors={**scene.sensors, CAMERA: sensor}),
        observations={
            **cfg.task.observations,
            CAMERA: ObservationGroupCfg(terms={CAMERA: picture}),
        },
    )
    modules: Any = cfg.modules
    # The bounds of bytes are known; distances have the sensor's.
    ends = (0.0, sensor.max_depth) if output == "depth" else None
    actor = replace(
        modules.actor,
        in_keys=(*modules.actor.in_keys, CAMERA),
        encoders={CAMERA: EncoderCfg(value_range=ends)},
    )
    return replace(cfg, task=task_cfg, modules=replace(modules, actor=actor))


def measure(cfg: RunCfg, *, output: Output) -> dict[str, float]:
    """Train some iterations of a run `with_camera`, and return the figures."""
    trainer = build(cfg)
    env: Any = trainer.collector.env
    world = env.base_env.world
    assert isinstance(world, WarpWorld)
    schedule = SCHEDULES[world.device.type]
    # The first iterations, which record graphs, are not timed.
    training_ms = iteration_ms(trainer)
    rollout_ms = milliseconds(
        trainer.collector.collect, device=world.device, repeats=schedule.repeats
    )
    of_rollout = num_env_states(cfg)
    camera = cfg.task.scene.sensors[CAMERA]
    assert isinstance(camera, CameraSensor)
    drawn_ms = _drawn_ms(world, camera, output=output, repeats=schedule.repeats)
    renderer_ms, renderer_bytes = _renderer_ms(world, camera, repeats=schedule.repeats)
    figures = {
        "renderer_frames_per_s": 1000.0 * world.num_envs / renderer_ms,
        "drawn_frames_per_s": 1000.0 * world.num_envs / drawn_ms,
        "rollout_frames_per_s": 1000.0 * of_rollout / rollout_ms,
        "training_frames_per_s": 1000.0 * of_rollout / training_ms,
        "renderer_bytes_per_env": renderer_bytes / world.num_envs,
        "rollout_bytes_per_env": _rollout_bytes(trainer) / world.num_envs,
    }
    if world.device.type == "cuda":
        figures["torch_bytes_per_env"] = (
            torch.cuda.max_memory_reserved(world.device) / world.num_envs
        )
    env.close(raise_if_closed=False)
    return figures


@torch.no_grad()
def _drawn_ms(world: WarpWorld, sensor: CameraSensor, *, output: Output, repeats: int) -> float:
    """Time what a term's reading takes: drawing all worlds, and a copy of the pictures."""
    camera = BatchCamera(world, CAMERA, sensor.picture())
    world.refresh()

    def pictures() -> torch.Tensor:
        return camera.rgb_EHW3 if output == "rgb" else camera.depth_EHW

    kept = pictures().clone()

    def draw() -> None:
        camera.render()
        kept.copy_(pictures())

    captured = Captured(draw, device=world.device, warmup=2)
    for _ in range(4):
        captured()
    return milliseconds(captured, device=world.device, repeats=4 * repeats)


def _renderer_ms(world: WarpWorld, sensor: CameraSensor, *, repeats: int) -> tuple[float, int]:
    """Time MuJoCo Warp's own calls, as one graph; return the bytes of its context as well."""
    world.refresh()
    with warp_scope(world.device):
        context = mjw.create_render_context(
            world.mj_model,
            nworld=world.num_envs,
            cam_res=(sensor.width, sensor.height),
            render_rgb=sensor.rgb,
            render_depth=sensor.depth,
            use_textures=sensor.textures,
            use_shadows=sensor.shadows,
            render_skybox=sensor.textures,
            enabled_geom_groups=list(sensor.geom_groups),
            cam_active=[CAMERA],
        )

    def draw() -> None:
        mjw.refit_bvh(world.warp_model, world.warp_data_E, context)
        mjw.render(world.warp_model, world.warp_data_E, context)

    replay = as_graph(draw, world.device)
    held = 0
    for value in vars(context).values():
        if isinstance(value, wp.array):
            held += value.capacity
    return milliseconds(replay, device=world.device, repeats=4 * repeats), held


def _rollout_bytes(trainer: Trainer) -> int:
    rollout_ET: Any = trainer.rollout_ET
    places = {}
    # The pictures after a step may share memory with those before the next.
    for leaf in rollout_ET.values(True, True):
        storage = leaf.untyped_storage()
        places[storage.data_ptr()] = storage.nbytes()
    return sum(places.values())


def main() -> None:
    """Measure each combination, and print and write its figures."""
    own, words = command_line.split(sys.argv[1:], OWN_OPTIONS)
    tasks, outputs = own["tasks"].split(","), own["outputs"].split(",")
    for task in tasks:
        check_choice("tasks", task, CAMERAS)
    for output in outputs:
        check_choice("outputs", output, OUTPUTS)
    counts = command_line.whole_numbers("num_envs", own["num_envs"])
    sizes = command_line.whole_numbers("sizes", own["sizes"])
    table = Table(title="frames per second")
    for column in ("task", "envs", "pixels", "output", *SPEEDS, "bytes of a rollout per env"):
        table.add_column(column)
    for num_envs, size, task, output in itertools.product(counts, sizes, tasks, OUTPUTS):
        if output in outputs:
            figures = _one(task, num_envs, size, output, words)
            speeds = [f"{figures[f'{name}_frames_per_s']:,.0f}" for name in SPEEDS]
            held = f"{figures['rollout_bytes_per_env']:,.0f}"
            table.add_row(task, str(num_envs), str(size), output, *speeds, held)
    Console(width=120).print(table)


def _one(
    task: str, num_envs: int, size: int, output: Output, words: Sequence[str]
) -> dict[str, float]:
    """Measure one combination, and write and print its figures."""
    cfg = command_line.compose(
        [f"task={task}", f"num_envs={num_envs}", "logger=none", "trainer.eval_episodes=0", *words]
    )
    device = cfg.resolved_device()
    figures = measure(with_camera(cfg, task, size=size, output=output), output=output)
    prefix = f"{report.device_label(device)}/{task}/{num_envs}/{size}"
    ahead = "depth_" if output == "depth" else ""
    named = {f"{prefix}/{ahead}{name}": round(value, 1) for name, value in figures.items()}
    for name, value in named.items():
        print(f"{name} {value:,.0f}", flush=True)
    report.write(NAME, figures=named, device=device, module="benchmarks.cameras")
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    return figures


if __name__ == "__main__":
    command_line.run(main)
