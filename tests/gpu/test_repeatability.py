"""Equal runs on a GPU have equal bits, whatever the order in which its threads come."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer

from ksim_rl import conf, mdp
from ksim_rl.data import PrioritySampler
from ksim_rl.physics import Captured, SimCfg, World, load_model
from ksim_rl.physics.nan_guard.guard import NanGuardCfg
from ksim_rl.ranks.running_moments import RunningMoments
from ksim_rl.tasks.rough_ground import on_rough_ground
from ksim_rl.trainers.build import build_env
from tests import kernels
from tests.docs.guide import REPOSITORY
from tests.physics.test_contacts import THINGS, touching

LOOKS = ("qpos", "qvel", "qacc", "qacc_warmstart", "sensordata", "cfrc_ext", "cacc", "xpos", "time")
STEPS, LOOK_EVERY = 100, 10


def everything(task: Any, folder: str) -> Any:
    """A velocity task on rough ground, with drawn inertias and friction, and what watches for bad states."""
    rough = on_rough_ground(task, root_height=0.3, njmax=200, nconmax=60)
    events = {
        "inertia": mdp.RandomizePseudoInertia(
            bodies="trunk", alpha=(-0.2, 0.2), stretch=(-0.1, 0.1)
        ),
        "friction": mdp.RandomizeGeomFriction(geoms=".*", ranges={0: (0.5, 1.5)}),
    }
    sim = dataclasses.replace(rough.sim, nan_guard=NanGuardCfg(folder=folder, history=3))
    return dataclasses.replace(rough, sim=sim, events={**events, **rough.events})


def walk(
    task: str, *, device: str, num_envs: int, steps: int = STEPS, folder: str = ""
) -> list[dict[str, torch.Tensor]]:
    """Return what env and physics hold after each tenth captured control step with random actions, on the CPU.

    With a `folder` the task is one with `everything`.
    """
    cfg = conf.compose([f"task={task}", f"device={device}", f"num_envs={num_envs}"])
    if folder:
        cfg = dataclasses.replace(cfg, task=everything(cfg.task, folder))
    env: Any = build_env(cfg, num_envs=num_envs, seed=1)
    root_E, world = env.reset(), env.base_env.world
    # Forces of bodies are computed from when on they are read, which the env's terms did not.
    world.is_frozen = False
    for name in LOOKS:
        world.view(name)
    generator = torch.Generator(device).manual_seed(0)
    action = torch.zeros_like(env.action_spec.rand())

    def body() -> None:
        _, after_E = env.step_and_maybe_reset(root_E.copy().set("action", action))
        for key in list(root_E.keys(True, True)):
            root_E.get(key).copy_(after_E.get(key))

    step = Captured(body, device=device, warmup=2)
    looks = []
    for number in range(1, steps + 1):
        action.copy_(2.0 * torch.rand(action.shape, device=device, generator=generator) - 1.0)
        step()
        if number % LOOK_EVERY == 0:
            looks.append({name: world.last_substep(name).cpu().clone() for name in LOOKS})
            looks[-1]["contacts"] = world.last_substep("nacon").cpu().clone()
            looks[-1] |= {
                str(key): root_E.get(key).cpu().float() for key in root_E.keys(True, True)
            }
    assert step.ready == (device == "cuda")
    env.close(raise_if_closed=False)
    return looks


def first_difference(
    one: list[dict[str, torch.Tensor]], other: list[dict[str, torch.Tensor]]
) -> str | None:
    """Return the step and the names of the arrays at which two runs differ first, with how many worlds do."""
    for number, (mine, theirs) in enumerate(zip(one, other, strict=True), start=1):
        differ = {name: _rows_that_differ(values, theirs[name]) for name, values in mine.items()}
        if any(differ.values()):
            return f"after step {number * LOOK_EVERY}, worlds that differ: {differ}"
    return None


def _rows_that_differ(one: torch.Tensor, other: torch.Tensor) -> int:
    differ = one.view(torch.int32) != other.view(torch.int32)
    return int(differ.reshape(differ.shape[0], -1).any(1).sum())


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("task", "has_everything"),
    [
        ("quadruped_velocity_flat", False),
        ("humanoid_get_up", False),
        ("quadruped_velocity_flat", True),
    ],
)
def test_equal_worlds_stay_equal_bit_for_bit(task, has_everything, tmp_path):
    folder = str(tmp_path) if has_everything else ""
    one, other = (walk(task, device="cuda", num_envs=512, folder=folder) for _ in range(2))
    assert int(one[-1]["contacts"]) > 512
    assert first_difference(one, other) is None


TENDON = """
<mujoco>
  <worldbody>
    <body><joint name="a" type="hinge"/><geom size="0.1" mass="1"/>
      <body pos="0.3 0 0"><joint name="b" type="hinge"/><geom size="0.1" mass="1"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="both"><joint joint="a" coef="0.3"/><joint joint="b" coef="-0.7"/></fixed></tendon>
  <sensor><tendonvel tendon="both"/></sensor>
</mujoco>
"""


# Boxes whose distance is measured, in a margin, and of other priorities, with a direct law; a pair that no joint
# can heed; and sensors of contacts that only such models have.
MENDED = """
<mujoco>
  <asset>
    <hfield name="hills" nrow="3" ncol="3" size="1 1 0.1 0.1" elevation="0 1 2 2 3 1 0 1 2"/>
    <mesh name="wedge" vertex="-.1 -.1 -.1 .1 -.1 -.1 0 .1 -.1 0 0 .1"/>
  </asset>
  <worldbody>
    <geom type="hfield" hfield="hills" pos="3 0 1"/>
    <geom name="floor" type="plane" size="5 5 1" priority="1" solref="-500 -10"/>
    <geom name="table" type="box" size="0.3 0.3 0.05"/><geom name="stone" size="0.1" pos="0 0 0.05"/>
    <body pos="0 0 0.14"><freejoint/>
      <geom name="box" type="box" size="0.1 0.1 0.1" margin="0.05"/><site name="zone" size="0.3"/>
    </body>
    <body pos="3 0 1.18"><freejoint/><geom type="mesh" mesh="wedge"/></body>
  </worldbody>
  <contact><pair geom1="table" geom2="stone"/></contact>
  <sensor>
    <touch site="zone" cutoff="5"/><contact geom1="box" num="4" data="found force pos"/>
    <distance geom1="box" geom2="table" cutoff="1"/><fromto geom1="box" geom2="table" cutoff="1"/>
  </sensor>
</mujoco>
"""


def mended(device: str, *, one_kernel: bool) -> list[torch.Tensor]:
    """What kernels leave that mend contacts and sensors of MuJoCo Warp's."""
    sim = SimCfg(njmax=120, nconmax=40, one_kernel_dynamics=one_kernel)
    world = World(load_model(MENDED), num_envs=8, device=device, sim=sim)
    world.qpos_EL[:, 3:6] += 0.1 * torch.arange(24.0, device=device).view(8, 3).sin()
    world.step()
    contact, count = world.warp_data_E.contact, int(world.warp_data_E.nacon.numpy()[0])
    fields = (
        getattr(contact, name).numpy()[:count]
        for name in ("geom", "worldid", "type", "pos", "solref")
    )
    rows = np.concatenate([field.reshape(count, -1) for field in fields], axis=1)
    return [torch.tensor(sorted(map(tuple, rows))), world.view("sensordata").cpu().clone()]


# Limits, and sensors of them, a disabled actuator with an activation, a gain that depends
# on velocity, adhesion beside a measured pair, a delayed control, and an exact filter.
DRIVEN = """
<mujoco>
  <option integrator="{integrator}" actuatorgroupdisable="1"/>
  <worldbody>
    <geom type="plane" size="5 5 1"/><geom name="post" pos="1 0 0.1" size="0.1"/>
    <body pos="0 0 0.5"><joint name="arm" axis="0 1 0" range="-2 2" limited="true" margin="0.1"/>
      <geom size="0.1" pos="0.2 0 0" contype="0" conaffinity="0"/></body>
    <body name="ball" pos="2 0 0.099"><joint name="lift" type="slide" axis="0 0 1"/>
      <geom name="ball" size="0.1" adhesion="1"/></body>
    <body pos="0 2 1"><freejoint name="drone"/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <position joint="drone" kp="2" kv="1" gear="1 0 1 0 0.5 0"/>
    <intvelocity joint="arm" group="1" kp="5" actrange="-1 1"/>
    <general joint="arm" gaintype="affine" gainprm="1 0 -0.1" ctrllimited="true" ctrlrange="-0.1 0.1"/>
    <position name="servo" joint="arm" kp="2" delay="0.004" nsample="3"/><adhesion body="ball" ctrlrange="0 1"/>
    <general joint="arm" dyntype="filterexact" dynprm="0.05" gainprm="0.3"/>
  </actuator>
  <sensor>
    <jointlimitpos joint="arm"/><jointlimitvel joint="arm"/><jointlimitfrc joint="arm"/>
    <distance geom1="ball" geom2="post" cutoff="2"/><actuatorpos actuator="servo"/>
  </sensor>
</mujoco>
"""


def driven(device: str, integrator: str) -> list[torch.Tensor]:
    """What kernels leave that mend actuators, limits, their sensors and the integration of MuJoCo Warp's."""
    world = World(load_model(DRIVEN.format(integrator=integrator)), num_envs=8, device=device)
    world.qvel_EL[:, 0] = torch.arange(8.0, device=device).sin()
    world.ctrl_EL.fill_(0.5)
    world.step(5)
    world.refresh()
    return [
        world.view(name).cpu().clone()
        for name in ("qpos", "qvel", "act", "sensordata", "actuator_velocity")
    ]


# A table that worlds have elsewhere, a tool without joints that is tied, a body that only slides beside a tendon, and a
# beam that turns about its middle.
VARIED = """
<mujoco>
  <worldbody>
    <body pos="0 0 0.4"><geom type="box" size="0.5 0.5 0.05"/></body>
    <body pos="0 0 0.56"><freejoint/><geom size="0.1" mass="1"/>
      <body name="tool" pos="0.1 0 0"><geom size="0.02"/></body></body>
    <body name="arm" pos="1 0 1"><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body>
    <body name="lift" pos="2 0 1"><joint name="b" type="slide" axis="0 0 1"/><geom size="0.1"/></body>
    <body pos="0.9 0 0.4"><joint axis="0 1 0"/>
      <geom type="capsule" size="0.05 0.5" mass="1" euler="0 90 0"/></body>
  </worldbody>
  <tendon><fixed><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>
  <equality><connect body1="tool" body2="arm" anchor="0 0 0"/><weld body1="lift"/></equality>
</mujoco>
"""


def varied(device: str) -> list[torch.Tensor]:
    """What kernels leave that follow fields of a world."""
    fields = ("body_pos", "body_mass")
    sim = SimCfg(one_kernel_dynamics=False)
    world = World(load_model(VARIED), num_envs=8, device=device, sim=sim, per_world_fields=fields)
    scale = 1.0 + 0.1 * torch.arange(8.0, device=device).sin()
    for name in fields:
        field = world.field(name)
        field *= scale.view(8, *[1] * (field.ndim - 1))
    world.set_const(fields)
    world.step(5)
    world.refresh()
    of_fields = [world.field(name).cpu().clone() for name in ("body_invweight0", "dof_invweight0")]
    return [*of_fields, *(world.view(name).cpu().clone() for name in ("qpos", "qvel", "geom_xpos"))]


def cramped(device: str) -> list[torch.Tensor]:
    """What kernels leave of worlds that have too little room for their ties."""
    world = World(
        load_model(VARIED), num_envs=8, device=device, sim=SimCfg(njmax=2, one_kernel_solver=False)
    )
    world.step(2)
    return [world.view(name).cpu().clone() for name in ("qpos", "qvel")]


def single(device: str) -> list[torch.Tensor]:
    """What kernels leave that few models have: contacts of steep rods, in an order of their own, and tendons."""
    mj_model = load_model(THINGS.format(turned=""))
    rods = World(
        mj_model,
        num_envs=8,
        device=device,
        sim=SimCfg(njmax=120, nconmax=24, one_kernel_dynamics=False),
    )
    rods.qpos_EL.copy_(touching(mj_model, seed=0)[:8])
    tendons = World(
        load_model(TENDON), num_envs=8, device=device, sim=SimCfg(one_kernel_dynamics=False)
    )
    tendons.qvel_EL.copy_(torch.arange(16.0).view(8, 2).sin())
    rods.step()
    tendons.refresh()
    contact, count = rods.warp_data_E.contact, int(rods.warp_data_E.nacon.numpy()[0])
    fields = (
        getattr(contact, name).numpy()[:count] for name in ("geom", "worldid", "pos", "frame")
    )
    rows = np.concatenate([field.reshape(count, -1) for field in fields], axis=1)
    found = [torch.tensor(sorted(map(tuple, rows))), tendons.view("ten_velocity").cpu().clone()]
    found += driven(device, "implicitfast") + driven(device, "RK4") + varied(device)
    found += cramped(device)
    return [*found, *mended(device, one_kernel=True), *mended(device, one_kernel=False)]


@pytest.mark.gpu
def test_kernels_of_single_models_give_the_same_bits_again():
    assert all(
        torch.equal(one, other) for one, other in zip(single("cuda"), single("cuda"), strict=True)
    )


@pytest.mark.full
def test_single_models_launch_each_kernel_that_is_said_to_be_tested_with_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    launched: set[str] = set()
    launch = wp.launch

    def noted(kernel: wp.Kernel, *given: Any, **named: Any) -> None:
        launched.update(kernel.key.split("__locals__"))
        launch(kernel, *given, **named)

    monkeypatch.setattr(wp, "launch", noted)
    single("cpu")
    said = set()
    for file, tests in kernels.TESTS.items():
        # Kernels of C++ are launched elsewhere.
        of_warp = re.findall(
            r"@wp\.kernel.*\ndef (\w+)", (REPOSITORY / "ksim_rl" / file).read_text()
        )
        said |= {name for name in of_warp if tests.get(name) == kernels.SINGLE_MODELS}
    assert len(said) > 20
    assert said <= launched, said - launched


@pytest.mark.gpu
def test_prioritized_draws_from_equal_priorities_are_equal():
    size, drawn = 2**22, []
    for _ in range(2):
        sampler = PrioritySampler(size, device="cuda")
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(size, device="cuda"), sampler=sampler, batch_size=2**16
        )
        buffer.extend(TensorDict({"number": torch.arange(size, device="cuda")}, [size]))
        generator = torch.Generator("cuda").manual_seed(0)
        priority_N = torch.rand(size, device="cuda", generator=generator)
        buffer.update_priority(torch.arange(size, device="cuda"), priority_N)
        torch.manual_seed(1)
        drawn.append(buffer.sample()["number"])
    assert torch.equal(*drawn)


@pytest.mark.gpu
def test_moments_of_equal_rows_are_equal_and_those_of_two_passes_in_float64():
    torch.manual_seed(0)
    rows = torch.randn(98304, 48) * torch.logspace(-3, 3, 48) + torch.linspace(-1e3, 1e3, 48)
    rows[5, 7] = torch.nan
    valid = torch.arange(len(rows)) % 3 > 0
    first, second = (RunningMoments(48, device="cuda") for _ in range(2))
    for moments in (first, second):
        for _ in range(2):
            moments.update(rows.cuda(), valid.cuda())
    for name, buffer in first.named_buffers():
        assert torch.equal(buffer, second.get_buffer(name)), name
    seen = rows[valid & rows.isfinite().all(-1)].double()
    torch.testing.assert_close(first.mean.cpu(), seen.mean(0).float(), rtol=1e-6, atol=0.0)
    torch.testing.assert_close(
        first.var.cpu(), seen.var(0, correction=0).float(), rtol=1e-6, atol=0.0
    )
    assert first.count == 2 * len(seen)
