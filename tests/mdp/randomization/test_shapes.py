"""Objects of another size in each world equal models that MuJoCo compiles with these sizes."""

import dataclasses

import mujoco
import numpy as np
import pytest

from ksim_rl import envs, mdp
from ksim_rl.scene.objects import Box, Capsule, Cylinder, Mesh, Sphere
from ksim_rl.scene.scene import MjcfRobot, Placement

E = 4
# What is randomized, and the fields of the object by the columns of its geom's size.
THINGS = {
    "box": (Box(size=(0.1, 0.2, 0.3), mass=1.2), lambda s: {"size": tuple(2.0 * s[:3])}),
    "sphere": (Sphere(radius=0.05, mass=0.4), lambda s: {"radius": s[0]}),
    "cylinder": (
        Cylinder(radius=0.04, length=0.2, mass=0.6),
        lambda s: {"radius": s[0], "length": 2.0 * s[1]},
    ),
    "capsule": (
        Capsule(radius=0.04, length=0.3, mass=0.7),
        lambda s: {"radius": s[0], "length": 2.0 * s[1]},
    ),
}
EGG = """
<mujoco><worldbody><body name="egg"><freejoint/>
  <geom name="egg" type="ellipsoid" size="0.03 0.04 0.06" mass="0.2"/>
</body></worldbody></mujoco>"""
HEIGHT = 0.5


@pytest.fixture(scope="module")
def env():
    cfg = envs.make_cfg("arm_reach")
    objects = {name: thing for name, (thing, _) in THINGS.items()}
    objects["egg"] = MjcfRobot(source=EGG)
    names = [f"{name}/{name}" for name in objects]
    events = {
        "size": mdp.RandomizeSolidSize(
            geoms=tuple(names[:2] + names[3:4]), ranges=(0.5, 1.5), operation="scale"
        ),
        "dense": mdp.RandomizeSolidSize(
            geoms=(names[2], names[4]), ranges={0: (0.03, 0.06)}, constant="density"
        ),
    }
    # Turned, so that more than one size says how far each reaches down.
    for name in objects:
        events[f"turn {name}"] = mdp.ResetRootUniform(
            entity=name, pose_range=dict.fromkeys(("roll", "pitch", "yaw"), (-1.0, 1.0))
        )
        events[f"down {name}"] = mdp.SetDown(entity=name, height=HEIGHT)
    places = {name: Placement(pos=(2.0 * n + 2.0, 0.0, 0.0)) for n, name in enumerate(objects)}
    scene = dataclasses.replace(cfg.scene, objects=objects, placements=places, num_envs=E)
    prefixed = envs.make_cfg("arm_push")
    cfg = dataclasses.replace(
        prefixed,
        scene=scene,
        observations={},
        commands={},
        rewards={},
        metrics={},
        events=events,
        # The engine that compiles nothing.
        sim=dataclasses.replace(cfg.sim, engine="c"),
        seed=3,
    )
    made = envs.build(cfg).base_env
    made.reset()
    return made


@pytest.mark.parametrize("name", THINGS)
def test_each_world_is_a_model_of_its_sizes(env, name):
    thing, fields_of = THINGS[name]
    model = env.world.mj_model
    geom, body = model.geom(f"{name}/{name}").id, model.body(f"{name}/{name}").id
    size_E3 = env.view.field("geom_size")[:, geom].double().numpy()
    assert np.ptp(size_E3[:, 0]) > 0.005
    for row, size_3 in enumerate(size_E3):
        mass = float(env.view.field("body_mass")[row, body])
        own = dataclasses.replace(thing, **fields_of(size_3), mass=mass).spec().compile()
        np.testing.assert_allclose(
            env.view.field("body_inertia")[row, body], own.body_inertia[1], rtol=1e-4
        )
        if name != "cylinder":
            assert mass == pytest.approx(thing.mass)
            continue
        # The same density: as much more mass as volume, which MuJoCo computes from a density.
        assert mass / size_3[0] ** 2 == pytest.approx(thing.mass / thing.radius**2, rel=1e-5)


@pytest.mark.parametrize("name", [*THINGS, "egg"])
def test_each_is_set_down_whatever_its_size_and_pose(env, name):
    view = env.view
    model = env.world.mj_model
    geom = model.geom(f"{name}/{name}").id
    entity = view.entity(name)
    for row in range(E):
        # The lowest point by the support function of the geom: a fine net over its surface.
        quat_4 = entity.root_quat_EL[row : row + 1]
        size_3 = view.field("geom_size")[row, geom].double().numpy()
        points_N3 = surface(name, size_3)
        turned_N3 = rotated(points_N3, quat_4)
        lowest = float(entity.root_pos_EL[row, 2]) + turned_N3[:, 2].min()
        assert lowest == pytest.approx(HEIGHT, abs=1e-3)


def rotated(points_N3, quat_14):
    matrix_9 = np.zeros(9)
    mujoco.mju_quat2Mat(matrix_9, quat_14[0].double().numpy())
    return points_N3 @ matrix_9.reshape(3, 3).T


def surface(name, size_3):
    """Points of the surface of a geom."""
    draw = np.random.default_rng(0)
    ball_N3 = draw.normal(size=(40_000, 3))
    ball_N3 /= np.linalg.norm(ball_N3, axis=1, keepdims=True)
    a, b, _ = size_3
    if name == "box":
        return np.sign(ball_N3) * size_3
    if name == "sphere":
        return a * ball_N3
    if name == "egg":
        return ball_N3 * size_3
    ends_N3 = np.sign(ball_N3[:, 2:]) * np.array([[0.0, 0.0, b]])
    if name == "capsule":
        return a * ball_N3 + ends_N3
    rim_N2 = ball_N3[:, :2] / np.linalg.norm(ball_N3[:, :2], axis=1, keepdims=True)
    return np.concatenate((a * rim_N2, ends_N3[:, 2:]), axis=1)


def test_what_has_no_size_of_its_own_is_refused(tmp_path):
    file = tmp_path / "corner.obj"
    file.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    two = EGG.replace("</body>", '<geom name="yolk" size="0.01" mass="0.1"/></body>')
    hung = EGG.replace(
        "</body>", '<body><joint axis="0 0 1"/><geom size="0.1" mass="0.1"/></body></body>'
    )
    for thing, event, message in (
        (
            Mesh(file=str(file)),
            mdp.RandomizeSolidSize(geoms="cube/mesh", ranges=(0.5, 1.0)),
            "a mesh, has 0 sizes",
        ),
        (
            Mesh(file=str(file)),
            mdp.SetDown(entity="cube"),
            "is not one primitive geom about its origin",
        ),
        (MjcfRobot(source=two), mdp.SetDown(entity="cube"), "is not one primitive geom"),
        (
            MjcfRobot(source=two),
            mdp.RandomizeSolidSize(geoms="cube/yolk", ranges={0: (0.01, 0.02)}),
            "has another mass or inertia than geom 'cube/yolk' alone",
        ),
        (MjcfRobot(source=hung), mdp.SetDown(entity="cube"), "is not one primitive geom"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.build(one_thing(thing, {"event": event}))


def one_thing(thing, events, num_envs=1):
    cfg = envs.make_cfg("arm_push")
    return dataclasses.replace(
        cfg,
        scene=dataclasses.replace(cfg.scene, objects={"cube": thing}, num_envs=num_envs),
        observations={},
        commands={},
        rewards={},
        metrics={},
        events=events,
        sim=dataclasses.replace(cfg.sim, engine="c"),
    )


SIZE = mdp.RandomizeSolidSize(geoms="cube/box", ranges=(0.5, 1.5), operation="scale")
MASS = mdp.RandomizeBodyMass(bodies="cube/box", ranges=(0.5, 2.0))


def test_masses_are_drawn_before_the_size():
    made = envs.build(one_thing(Box(mass=0.3), {"mass": MASS, "size": SIZE}, num_envs=3)).base_env
    made.reset()
    body = made.world.mj_model.body("cube/box").id
    geom = made.world.mj_model.geom("cube/box").id
    mass_E = made.view.field("body_mass")[:, body]
    assert len(set(mass_E.tolist())) == 3 and mass_E.min() >= 0.15 and mass_E.max() <= 0.6
    # Of a box of its half edges.
    size_E3 = made.view.field("geom_size")[:, geom]
    first_E = mass_E * (size_E3[:, 1] ** 2 + size_E3[:, 2] ** 2) / 3.0
    np.testing.assert_allclose(made.view.field("body_inertia")[:, body, 0], first_E, rtol=1e-5)


def test_what_would_undo_mass_or_inertia_is_refused(env):
    message = "events.mass draws mass or inertia of body '(cube|box)/box'"
    with pytest.raises(ValueError, match=message):
        envs.build(one_thing(Box(), {"size": SIZE, "mass": MASS}))
    size = dataclasses.replace(SIZE, geoms="box/box")
    mass = dataclasses.replace(MASS, bodies="box/box")
    size.check_beside(env.view, {"mass": mass, "size": size})
    size.check_beside(env.view, {"mass": dataclasses.replace(mass, bodies="egg/egg")})
    for event, beside in (
        (size, dataclasses.replace(mass, mode="reset")),
        (dataclasses.replace(size, constant="density"), mass),
        (size, mdp.RandomizePseudoInertia(bodies="box/box", alpha=(-0.1, 0.1))),
    ):
        with pytest.raises(ValueError, match=message):
            event.check_beside(env.view, {"mass": beside, "size": event})
