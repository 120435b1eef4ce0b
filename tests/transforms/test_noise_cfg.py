import pytest

from ksim_rl.transforms import (
    ConstantNoise,
    GaussianNoise,
    NoiseCfg,
    UniformNoise,
)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: UniformNoise(low=1.0, high=0.0), "low=1.0 exceeds high=0.0"),
        (lambda: UniformNoise(low=(0.0, 2.0), high=1.0), "exceeds"),
        (
            lambda: UniformNoise(low=(0.0, 0.0), high=(1.0, 1.0, 1.0)),
            "low has 2 numbers and high has 3",
        ),
        (lambda: UniformNoise(low=float("nan"), high=1.0), "low=nan"),
        (lambda: GaussianNoise(std=-1.0), "std=-1.0"),
        (lambda: GaussianNoise(std=(1.0, -1.0)), r"std\[1\]=-1.0"),
        (lambda: ConstantNoise(value="1"), "value='1'"),
        (lambda: ConstantNoise(value=1.0, operation="mul"), "operation='mul'.*multiply"),
        (
            lambda: ConstantNoise(
                value=1.0, bias=ConstantNoise(value=1.0, bias=ConstantNoise(value=1.0))
            ),
            "bias",
        ),
        (
            lambda: ConstantNoise(bias=ConstantNoise(walk_std=0.1)),
            "a bias has no walk_std of its own",
        ),
        (lambda: ConstantNoise(walk_std=-0.1), "walk_std=-0.1"),
        (lambda: ConstantNoise(resolution=(0.1, -0.1)), r"resolution\[1\]=-0.1"),
        (lambda: ConstantNoise(dropout=1.5), "dropout=1.5"),
        (lambda: ConstantNoise(lost="hold"), "lost='hold'"),
    ],
)
def test_wrong_values_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_the_base_cannot_be_built():
    with pytest.raises(TypeError):
        NoiseCfg()


def test_configs_are_values():
    assert UniformNoise(low=0.0, high=1.0) == UniformNoise(low=0.0, high=1.0)
    assert hash(GaussianNoise(std=(1.0, 2.0))) == hash(GaussianNoise(std=(1.0, 2.0)))
