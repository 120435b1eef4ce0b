import numpy as np
import torch

from ksim_rl.scene.small_matrices import product


def test_it_is_numpys_product_and_broadcasts():
    rng = np.random.default_rng(0)
    for left, right in (((4, 3, 3), (4, 3, 3)), ((5, 3), (4, 3, 3)), ((4, 2, 3, 3), (4, 2, 3, 1))):
        a, b = rng.normal(size=left), rng.normal(size=right)
        torch.testing.assert_close(product(torch.tensor(a), torch.tensor(b)), torch.tensor(a @ b))
