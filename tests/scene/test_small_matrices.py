import numpy as np
import torch

from ksim_rl.scene.small_matrices import plane_normal, product


def test_it_is_numpys_product_and_broadcasts():
    rng = np.random.default_rng(0)
    for left, right in (((4, 3, 3), (4, 3, 3)), ((5, 3), (4, 3, 3)), ((4, 2, 3, 3), (4, 2, 3, 1))):
        a, b = rng.normal(size=left), rng.normal(size=right)
        torch.testing.assert_close(product(torch.tensor(a), torch.tensor(b)), torch.tensor(a @ b))


def test_a_plane_through_points_is_numpys_least_squares_one():
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.8, 0.8, size=(64, 32, 3))
    slope = rng.uniform(-0.6, 0.6, size=(64, 1, 2))
    points[..., 2] = (slope * points[..., :2]).sum(-1) + rng.normal(scale=0.03, size=(64, 32)) + 5.0
    found = plane_normal(torch.tensor(points, dtype=torch.float32)).numpy()
    for row, normal in zip(points, found, strict=True):
        _, values, axes = np.linalg.svd(row - row.mean(0))
        assert values[2] < 0.3 * values[1]
        assert np.allclose(normal, axes[2] * np.sign(axes[2][2]), atol=2e-6)


def test_points_on_no_plane_have_the_z_axis():
    rng = np.random.default_rng(2)
    cloud = rng.normal(size=(32, 3))
    line = np.linspace(0.0, 1.0, 32)[:, None] * np.array([1.0, 2.0, 3.0])
    flat = cloud * np.array([1.0, 1.0, 0.0])
    broken = flat.copy()
    broken[3, 2] = np.nan
    rows = torch.tensor(np.stack((cloud, line, np.zeros((32, 3)), flat, broken)))
    assert torch.equal(plane_normal(rows.float()), torch.tensor([[0.0, 0.0, 1.0]]).expand(5, 3))
