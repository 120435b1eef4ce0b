"""Bodies against MuJoCo's C engine at random states."""

import mujoco
import numpy as np
import pytest

from ksim_rl import mdp
from tests.envs.random_states import FIXED_BASE, E, close, engine, random_bench, velocity
from tests.mdp.bench import FREE_BODY

CHAINS = {"free": (FREE_BODY, ("right", "left")), "fixed": (FIXED_BASE, ("wrist", "rod"))}


@pytest.fixture(scope="module", params=CHAINS)
def chain(request):
    """A bench, two of its bodies in the order of the term, and their ids."""
    source, names = CHAINS[request.param]
    bench = random_bench(source)
    return bench, names, [bench.world.mj_model.body(name).id for name in names]


def rotation(d):
    """The root's axes as rows: turns world vectors into its frame."""
    return d.xmat[1].reshape(3, 3).T


def test_positions(chain):
    bench, names, ids = chain
    close(
        bench.read(mdp.BodyPos(bodies=names, frame="world")),
        engine(bench, lambda m, d: d.xpos[ids].ravel()),
    )
    expected = engine(bench, lambda m, d: ((d.xpos[ids] - d.xpos[1]) @ rotation(d).T).ravel())
    close(bench.read(mdp.BodyPos(bodies=names)), expected)


def test_orientations(chain):
    bench, names, ids = chain

    def relative(m, d):
        return np.stack([rotation(d) @ d.xmat[i].reshape(3, 3) for i in ids])

    def in_world(m, d):
        return d.xmat[ids].reshape(-1, 3, 3)

    for frame, matrices in (("root", relative), ("world", in_world)):
        six = engine(
            bench, lambda m, d, matrices=matrices: matrices(m, d)[:, :, :2].swapaxes(1, 2).ravel()
        )
        close(bench.read(mdp.BodyRotation6d(bodies=names, frame=frame)), six)
        quat = bench.read(mdp.BodyQuat(bodies=names, frame=frame)).view(E, 2, 4)
        rows = []
        for row in quat.double().numpy():
            matrix = np.zeros(9)
            rows.append([])
            for q in row:
                mujoco.mju_quat2Mat(matrix, q)
                rows[-1].append(matrix.reshape(3, 3).copy())
        close(engine(bench, matrices), bench.world.qpos_EL.new_tensor(np.array(rows)))


def test_orientations_of_sites(chain):
    bench, _, _ = chain
    names = ("right_foot", "imu") if bench.world.mj_model.nsite == 3 else ("tip", "eye")
    ids = [bench.world.mj_model.site(name).id for name in names]

    def six(d, turn):
        return np.concatenate([(turn @ d.site_xmat[i].reshape(3, 3))[:, :2].T.ravel() for i in ids])

    world = bench.read(mdp.SiteRotation6d(sites=names, frame="world"))
    close(world, engine(bench, lambda m, d: six(d, np.eye(3))))
    close(
        bench.read(mdp.SiteRotation6d(sites=names)), engine(bench, lambda m, d: six(d, rotation(d)))
    )


def test_inertias(chain):
    bench, names, ids = chain
    close(
        bench.read(mdp.CenterOfMassInertia(bodies=names)),
        engine(bench, lambda m, d: d.cinert[ids].ravel()),
    )


@pytest.mark.parametrize(
    ("term", "part"), [(mdp.BodyLinVel, "linear"), (mdp.BodyAngVel, "angular")]
)
def test_velocities(chain, term, part):
    bench, names, ids = chain
    close(
        bench.read(term(bodies=names, frame="world")),
        engine(bench, lambda m, d: velocity(m, d, ids, part=part).ravel()),
    )
    # Over the ground, whatever the root does, in the root's axes.
    close(
        bench.read(term(bodies=names)),
        engine(bench, lambda m, d: (velocity(m, d, ids, part=part) @ rotation(d).T).ravel()),
    )


def test_centres_of_mass(chain):
    bench, names, ids = chain
    bodies, ids = (*names, "trunk" if "left" in names else "turret"), [*ids, 1]

    def speeds(m, d):
        mujoco.mj_subtreeVel(m, d)
        return d.subtree_linvel[ids]

    world = {"bodies": bodies, "frame": "world"}
    close(
        bench.read(mdp.CenterOfMassPos(**world)),
        engine(bench, lambda m, d: d.subtree_com[ids].ravel()),
    )
    close(
        bench.read(mdp.CenterOfMassVel(**world)), engine(bench, lambda m, d: speeds(m, d).ravel())
    )
    expected = engine(
        bench, lambda m, d: ((d.subtree_com[ids] - d.xpos[1]) @ rotation(d).T).ravel()
    )
    close(bench.read(mdp.CenterOfMassPos(bodies=bodies)), expected)
    expected = engine(bench, lambda m, d: (speeds(m, d) @ rotation(d).T).ravel())
    close(bench.read(mdp.CenterOfMassVel(bodies=bodies)), expected)
