"""Mirror images found from an env's terms, against the simulation of a robot and of its mirror image."""

import dataclasses

import pytest
import torch

from ksim_rl import envs, mdp
from ksim_rl.mdp.mirror_maps import mirror_maps, term_mirror
from ksim_rl.objectives import SymmetricAugmentation
from ksim_rl.transforms import POLAR, group_specs
from ksim_rl.transforms.innermost import innermost

STEPS = 15


@pytest.fixture(scope="module")
def env():
    """Return our quadruped in two worlds, undisturbed and as the model has it."""
    cfg = envs.make_cfg("quadruped_velocity_flat")
    events = {
        "reset_base": mdp.ResetRootUniform(pose_range={"z": (0.02, 0.02)}),
        "reset_robot_joints": mdp.ResetJoints(),
    }
    scene = dataclasses.replace(cfg.scene, num_envs=2)
    made = envs.build(dataclasses.replace(cfg, scene=scene, events=events, seed=0))
    made.eval()  # no sensor noise
    yield made
    made.close()


def _rollout(env, maps):
    """Return a rollout whose second env gets the mirror images of the first one's actions."""
    actions = torch.randn(STEPS, 1, maps["action"].size, generator=torch.Generator().manual_seed(3))
    both = iter(torch.cat((actions, maps["action"](actions)), dim=1))
    env.set_seed(1)
    return env.rollout(STEPS, lambda td: td.set("action", next(both)), break_when_any_done=False)


def test_the_mirrored_robot_does_what_the_mirror_shows(env):
    maps = mirror_maps(env)
    rollout_ET = _rollout(env, maps)
    assert not rollout_ET["next", "done"].any()
    for name, spec in group_specs(env).items():
        seen_TL = maps[name](rollout_ET["next", name][0])
        shown_TL = rollout_ET["next", name][1]
        for term in spec.terms:
            if term[-1] == "command":  # each env has its own
                continue
            columns = spec.slice(term)
            # Joint velocities and logarithms of forces after 15 control steps of a solver that stops early.
            torch.testing.assert_close(
                seen_TL[:, columns],
                shown_TL[:, columns],
                atol=2e-2,
                rtol=1e-2,
                msg=lambda text, where=f"{name} {term}": f"{where}: {text}",
            )
            plain_TL = rollout_ET["next", name][0][:, columns]
            if term[-1] not in ("foot_contact",):
                assert not torch.allclose(plain_TL, shown_TL[:, columns], atol=5e-2), term


def test_augmenting_twice_gives_the_env_states_themselves(env):
    maps = mirror_maps(env)
    states_D = _rollout(env, maps).select("actor", "critic", "action").reshape(-1)
    mirror = SymmetricAugmentation(maps)
    image_D = mirror.image(states_D)
    twice_D = mirror.image(image_D)
    for key in ("actor", "critic", "action"):
        assert torch.equal(twice_D[key], states_D[key])
        assert not torch.equal(image_D[key], states_D[key])


def test_a_height_scan_is_mirrored_row_by_row(env):
    scan = mdp.HeightScan(size=(0.2, 0.4), resolution=0.1)
    mirror = term_mirror(scan, innermost(env))
    # Three points along x in each of five rows along y.
    rows = torch.arange(15.0).view(5, 3)
    assert torch.equal(mirror(rows.flatten()).view(5, 3), rows.flip(0))


def test_terms_without_a_known_image_are_refused_until_one_is_given(env):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Wind(envs.ObservationTerm):
        def __call__(self, view):
            return view.root_pos_EL

    with pytest.raises(
        ValueError, match="the mirror image of Wind is not known.*term_mirror.register"
    ):
        term_mirror(Wind(), innermost(env))
    term_mirror.register(Wind, lambda term, env: POLAR)
    assert term_mirror(Wind(), innermost(env)) is POLAR
    with pytest.raises(ValueError, match="no observation group 'eyes'"):
        mirror_maps(env, ["eyes"])


def test_an_asymmetric_action_is_refused(env):
    inner = innermost(env)
    joints = inner.cfg.actions["joint_pos"].joints
    scales = {"front_left_.*": 0.3, "(?!front_left).*": 0.2}
    with pytest.raises(ValueError, match="scale .* is not its own mirror image"):
        term_mirror(mdp.JointPositionAction(joints=joints, scale=scales), inner)
    with pytest.raises(ValueError, match=r"clip=\(-1.0, 2.0\) is not symmetric"):
        term_mirror(mdp.JointPositionAction(joints=joints, clip=(-1.0, 2.0)), inner)
