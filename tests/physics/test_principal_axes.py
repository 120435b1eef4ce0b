import numpy as np
import torch

from ksim_rl.physics.constants.principal_axes import principal_axes


def rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_moments_and_axes_rebuild_the_matrices():
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(200, 3, 3)) * 10.0 ** rng.uniform(-2, 0, size=(200, 1, 3))
    matrices = factors @ factors.transpose(0, 2, 1)
    # Equal moments, two or all of them, have no axes of their own.
    matrices[0], matrices[1] = np.eye(3), 0.5 + np.eye(3)
    moments, quats = principal_axes(torch.tensor(matrices, dtype=torch.float32).view(100, 2, 3, 3))
    moments, quats = moments.view(-1, 3).double().numpy(), quats.view(-1, 4).double().numpy()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1.0, rtol=1e-6)
    for matrix, values, quat in zip(matrices, moments, quats, strict=True):
        axes, size = rotation(quat), np.abs(matrix).max()
        np.testing.assert_allclose(axes @ np.diag(values) @ axes.T, matrix, atol=2e-6 * size)
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(matrix), atol=2e-6 * size)


def test_a_diagonal_matrix_keeps_its_order_and_axes():
    moments, quat = principal_axes(torch.diag(torch.tensor([3.0, 1.0, 2.0])))
    assert moments.tolist() == [3.0, 1.0, 2.0] and quat.tolist() == [1.0, 0.0, 0.0, 0.0]
