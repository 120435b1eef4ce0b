"""Boxes on a plane: where they are, what terms read as the ground, and that they weigh nothing."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.scene.terrains import GroundBox, PlaneTerrain, PlaneWithBoxes
from ksim_rl.scene.terrains.terrain import BoxedGround

BOXES = (
    GroundBox(pos=(1.0, 0.0), size=(0.4, 1.0, 0.2)),
    GroundBox(pos=(1.1, 0.2), size=(0.2, 0.2, 0.5)),
)
POINTS = ((0.0, 0.0), (0.81, 0.0), (0.79, 0.0), (1.1, 0.2), (1.1, -0.2), (1.0, 0.51), (-9.0, 3.0))


def test_terms_read_the_ground_where_rays_of_the_c_engine_hit_it():
    spec = mujoco.MjSpec()
    PlaneWithBoxes(boxes=BOXES).add_to(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hits = []
    for x, y in POINTS:
        start = np.array((x, y, 5.0))
        hits.append(
            5.0
            - mujoco.mj_ray(
                model, data, start, np.array((0, 0, -1.0)), None, 1, -1, np.zeros(1, np.int32)
            )
        )
    ground = BoxedGround(2, torch.device("cpu"), BOXES)
    points_EN2 = torch.tensor(POINTS).expand(2, -1, 2)
    assert ground.heights(points_EN2).tolist() == [pytest.approx(hits, abs=1e-6)] * 2
    above = torch.cat((points_EN2, torch.full((2, len(POINTS), 1), 2.0)), dim=-1)
    assert ground.clearance(above)[0].tolist() == pytest.approx([2.0 - hit for hit in hits])
    assert {model.geom(g).bodyid[0] for g in range(model.ngeom)} == {model.body("terrain").id}
    assert float(model.body_subtreemass[0]) == 0.0


def test_without_a_box_it_is_refused():
    with pytest.raises(ValueError, match="boxes.*PlaneTerrain"):
        PlaneWithBoxes(boxes=())
    with pytest.raises(ValueError, match="size"):
        GroundBox(size=(0.1, 0.0, 0.1))
    assert PlaneTerrain() != PlaneWithBoxes(boxes=BOXES)
