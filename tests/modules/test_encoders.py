"""Encoders of pictures, against torch's own convolutions, closed forms and networks that are put together by hand."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn import functional
from torchrl.data import Composite, Unbounded
from torchrl.modules import ConvNet, set_recurrent_mode

from ksim_rl.device.state_tree import copy_into
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    DeterministicActorCfg,
    Encoder,
    EncoderCfg,
    QNetworkCfg,
    RecurrentCfg,
    SharedTrunkCfg,
    SpatialSoftmax,
    SquashedActorCfg,
    make_actor,
    make_critic,
    make_deterministic_actor,
    make_for_spec,
    make_q_network,
    make_recurrent_actor,
    make_shared_trunk,
    make_squashed_actor,
    picture_encoders,
    update_normalizers,
)
from ksim_rl.modules.network import ObservingNetwork

SMALL = EncoderCfg(channels=(4, 5), kernel_sizes=(3, 2), strides=(2, 1))
E, H, W = 6, 9, 8
SPEC = Composite(
    rgb=Unbounded((E, H, W, 3), dtype=torch.uint8),
    depth=Unbounded((E, H, W)),
    joints=Unbounded((E, 4)),
    shape=(E,),
)


def picture_spec(*shape, dtype=torch.uint8):
    return Unbounded(torch.Size(shape), dtype=dtype)


def observations(*batch):
    generator = torch.Generator().manual_seed(1)
    data = {
        "rgb": torch.randint(256, (*batch, H, W, 3), dtype=torch.uint8, generator=generator),
        "depth": torch.rand(*batch, H, W, generator=generator),
        "joints": torch.randn(*batch, 4, generator=generator),
    }
    return TensorDict(data, batch)


def by_torch(encoder, pictures_BCHW):
    """Convolve by torch's functions with the encoder's weights: strides 2 and 1, ReLU, all pixels side by side."""
    first, second = [part for part in encoder.modules() if isinstance(part, nn.Conv2d)]
    hidden = functional.conv2d(pictures_BCHW, first.weight, first.bias, stride=2).relu()
    return functional.conv2d(hidden, second.weight, second.bias).relu().flatten(1)


@pytest.mark.parametrize(
    ("shape", "dtype", "fields", "channels_first"),
    [
        ((H, W, 3), torch.uint8, {}, lambda x: x.permute(0, 3, 1, 2) / 255),
        ((H, W), torch.float32, {}, lambda x: x[:, None]),
        ((H, W), torch.float32, {"value_range": (0.5, 2.5)}, lambda x: (x[:, None] - 0.5) / 2),
        # Stacked pictures: the channels of the oldest frame first.
        (
            (2, H, W, 3),
            torch.uint8,
            {},
            lambda x: torch.cat([x[:, n].permute(0, 3, 1, 2) for n in (0, 1)], 1) / 255,
        ),
        ((2, H, W), torch.float32, {"layout": "CHW"}, lambda x: x),
        ((2, H, W), torch.float16, {"layout": "CHW"}, lambda x: x.float()),
        (
            (2, 3, H, W),
            torch.float32,
            {"layout": "CHW"},
            lambda x: torch.cat([x[:, 0], x[:, 1]], 1),
        ),
    ],
)
def test_features_are_those_of_torch(shape, dtype, fields, channels_first):
    cfg = EncoderCfg(channels=(4, 5), kernel_sizes=(3, 2), strides=(2, 1), **fields)
    encoder = Encoder(cfg, picture_spec(*shape, dtype=dtype))
    pictures_BT = torch.randint(200, (2, 3, *shape)).to(dtype)
    if dtype != torch.uint8:
        pictures_BT = pictures_BT / 100
    features_BTF = encoder(pictures_BT)
    expected = by_torch(encoder, channels_first(pictures_BT.flatten(0, 1)))
    torch.testing.assert_close(features_BTF, expected.unflatten(0, (2, 3)))
    assert features_BTF.shape[-1] == encoder.num_features


# Windows of whole blocks of 4, 3 and 2 pixels, of single pixels, and windows that their stride does not divide.
@pytest.mark.parametrize(("kernel_size", "stride"), [(8, 4), (3, 3), (4, 2), (2, 1), (5, 2)])
def test_blocks_of_pixels_are_read_as_by_torchrls_network(kernel_size, stride):
    sizes = {"kernel_sizes": (kernel_size, 2), "strides": (stride, 1)}
    # Neither side is a multiple of a stride, so that some rows and columns are read by no window.
    spec = picture_spec(2, 22, 19, 3)
    encoder = Encoder(EncoderCfg(channels=(4, 5), **sizes), spec)
    plain = ConvNet(
        in_features=6,
        num_cells=[4, 5],
        **sizes,
        activation_class=nn.ReLU,
        aggregator_class=nn.Flatten,
        aggregator_kwargs={},
    )
    # A state of TorchRL's network is one of the encoder's.
    encoder.layers[1].load_state_dict(plain.state_dict())
    pictures = torch.randint(256, (3, *spec.shape), dtype=torch.uint8)
    expected = plain(torch.cat([pictures[:, 0], pictures[:, 1]], -1).permute(0, 3, 1, 2) / 255)
    features = encoder(pictures)
    torch.testing.assert_close(features, expected, atol=1e-6, rtol=1e-6)
    weights = (torch.linspace(0.0, 1.0, expected.numel()).reshape(expected.shape),)
    found = torch.autograd.grad(features, list(encoder.parameters()), weights)
    for gradient, other in zip(
        found, torch.autograd.grad(expected, list(plain.parameters()), weights), strict=True
    ):
        torch.testing.assert_close(gradient, other, atol=1e-5, rtol=1e-5)
    # Autocast rounds weights, and no byte: 255 has as many digits as bfloat16.
    exact = encoder.layers[0](pictures)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = encoder.layers[0](pictures)
    assert rounded.dtype == torch.bfloat16 and torch.equal(rounded.float(), exact)


@pytest.mark.parametrize("over", ["pictures", "weights", "both"])
def test_under_vmap_autocast_rounds_nothing_and_pictures_are_read_all_the_same(over):
    """Within torch.func.vmap autocast leaves convolutions as they are, so that bytes have to become floats."""
    torch.manual_seed(0)
    encoder = Encoder(SMALL, picture_spec(H, W, 3))
    pictures = torch.randint(256, (2, E, H, W, 3), dtype=torch.uint8)
    weights = {name: torch.stack((own, own + 0.1)) for name, own in encoder.named_parameters()}

    def call(own, seen):
        return torch.func.functional_call(encoder, own, (seen,))

    in_dims = {"pictures": (None, 0), "weights": (0, None), "both": (0, 0)}[over]
    given = (
        weights if in_dims[0] == 0 else dict(encoder.named_parameters()),
        pictures if in_dims[1] == 0 else pictures[0],
    )
    expected = []
    for place in range(2):
        own = {name: value[place] for name, value in weights.items()}
        expected.append(
            call(
                own if in_dims[0] == 0 else given[0],
                pictures[place] if in_dims[1] == 0 else given[1],
            )
        )
    with torch.autocast("cpu", torch.bfloat16):
        found = torch.func.vmap(call, in_dims=in_dims)(*given)
    torch.testing.assert_close(found, torch.stack(expected), atol=1e-5, rtol=1e-5)


def test_gradients_of_a_function_are_rounded_as_those_of_a_backward_pass():
    encoder = Encoder(SMALL, picture_spec(H, W, 3))
    pictures = torch.randint(256, (E, H, W, 3), dtype=torch.uint8)
    own = dict(encoder.named_parameters())
    with torch.autocast("cpu", torch.bfloat16):
        features = encoder(pictures)
        assert features.dtype == torch.bfloat16
        found = torch.func.grad(
            lambda weights: torch.func.functional_call(encoder, weights, (pictures,)).float().sum()
        )(own)
    expected = torch.autograd.grad(features.float().sum(), list(own.values()))
    for name, gradient in zip(own, expected, strict=True):
        torch.testing.assert_close(found[name], gradient)


def test_one_picture_has_one_layout_for_all_networks():
    spec = Composite(rgb=Unbounded((2, 9, 9, 9), dtype=torch.uint8))
    networks = []
    for layout in ("HWC", "HWC", "CHW"):
        cfg = CriticCfg(
            in_keys=("rgb",), encoders={"rgb": replace(SMALL, layout=layout)}, hidden_dims=(4,)
        )
        networks.append(make_for_spec(make_critic, cfg, spec))
    found = picture_encoders(*networks[:2])
    assert list(found) == ["rgb"] and found["rgb"].layout == "HWC"
    with pytest.raises(ValueError, match="encoders.rgb.layout: .* 'HWC' and another one as 'CHW'"):
        picture_encoders(*networks)


def test_spatial_softmax_is_where_a_channel_is_brightest():
    # One pixel far above all others, of 5 rows and 3 columns; and a channel without any difference.
    channels_BCHW = torch.zeros(1, 3, 5, 3)
    channels_BCHW[0, 0, 4, 0] = 60.0
    channels_BCHW[0, 1, 1, 2] = 60.0
    found = SpatialSoftmax()(channels_BCHW)[0]
    torch.testing.assert_close(found, torch.tensor([-1.0, 1.0, 0.0, 1.0, -0.5, 0.0]))
    # Two of equal height: in the middle between them, whatever the rest.
    channels_BCHW[0, 0, 0, 0] = 60.0
    torch.testing.assert_close(
        SpatialSoftmax()(channels_BCHW)[0, [0, 3]], torch.tensor([-1.0, 0.0])
    )
    encoder = Encoder(
        EncoderCfg(channels=(7,), kernel_sizes=(3,), strides=(1,), spatial_softmax=True),
        picture_spec(H, W, 3),
    )
    assert encoder.num_features == 14


def test_a_state_of_pictures_of_another_size_is_refused():
    cfg = EncoderCfg(channels=(7,), kernel_sizes=(3,), strides=(1,), spatial_softmax=True)
    learned = Encoder(cfg, picture_spec(H, W, 3)).state_dict()
    same = Encoder(cfg, picture_spec(H, W, 3))
    same.load_state_dict(learned)
    assert torch.equal(same.state_dict()["_extra_state"], torch.tensor([H, W, 3]))
    larger = Encoder(cfg, picture_spec(2 * H, W, 3))
    with pytest.raises(ValueError, match=rf"pictures \[{2 * H}, {W}, 3\].*\[{H}, {W}, 3\]"):
        larger.load_state_dict(learned)
    # As checkpoints are read.
    copy_into(same.state_dict(), learned, what="actor")
    sizes = rf"actor: '_extra_state' is \[{H}, {W}, 3\] in the checkpoint and \[{2 * H}, {W}, 3\]"
    with pytest.raises(ValueError, match=sizes):
        copy_into(larger.state_dict(), learned, what="actor")
    # States of before shapes were in them.
    del learned["_extra_state"]
    larger.load_state_dict(learned)
    copy_into(same.state_dict(), learned, what="actor")


class Brightness(EncoderCfg):
    """A user's own: the mean of each channel."""

    def build(self, spec, *, device=None):
        class Mean(nn.Module):
            def forward(self, pictures_BHWC):
                return pictures_BHWC.float().mean((1, 2))

        return Mean()


def network(make, cfg_class, *, in_keys=("rgb", "joints", "depth"), **options):
    """Return a network that reads two pictures, one through an encoder of a user, and a vector between them."""
    fields = {"in_keys": in_keys, "hidden_dims": (5,)}
    encoders = {"rgb": Brightness(), "depth": SMALL}
    cfg = cfg_class(**fields, encoders={key: encoders[key] for key in in_keys if key in encoders})
    return make_for_spec(make, cfg, SPEC, **options)


ACTION = {"action_spec": Unbounded(2)}
NETWORKS = {
    "actor": (make_actor, ActorCfg, ACTION, "loc"),
    "critic": (make_critic, CriticCfg, {}, "state_value"),
    "trunk": (make_shared_trunk, SharedTrunkCfg, {}, "features"),
    "squashed": (make_squashed_actor, SquashedActorCfg, ACTION, "loc"),
    "deterministic": (make_deterministic_actor, DeterministicActorCfg, ACTION, "action"),
    "q": (make_q_network, QNetworkCfg, {"action_dim": 2}, "state_action_value"),
}


@pytest.mark.parametrize("name", list(NETWORKS))
def test_each_network_reads_vectors_normalized_and_behind_them_features(name):
    make, cfg_class, options, out_key = NETWORKS[name]
    built = network(make, cfg_class, **options)
    data = observations(E).set("action", torch.zeros(E, 2))
    # Statistics of the vector alone, from other data.
    update_normalizers(observations(2, E), built)
    # The network itself, behind its encoders, which are read by hand here.
    inner = next(part for part in built.modules() if isinstance(part, ObservingNetwork))
    (encoder,) = [part for part in built.modules() if isinstance(part, nn.Conv2d)][:1]
    depth = next(
        part for part in built.modules() if isinstance(part, Encoder) and encoder in part.modules()
    )
    normal = inner.normalizer
    assert (normal.dim, int(normal.count)) == (4, 2 * E)
    seen = torch.cat(
        (
            (data["joints"] - normal.mean) / (normal.var + normal.eps).sqrt(),
            data["rgb"].float().mean((1, 2)),
            by_torch(depth, data["depth"][:, None]),
        ),
        -1,
    )
    # The same layers, on numbers that need no encoder and no normalizer.
    inner.normalizer = None
    inputs = [seen, data["action"]] if name == "q" else [seen]
    outputs = inner(*inputs)
    expected = outputs[0] if isinstance(outputs, tuple) else outputs
    inner.normalizer = normal
    out = built(data.clone())
    torch.testing.assert_close(out[out_key], expected)
    # What learns the network learns its encoders.
    out[out_key].sum().backward()
    assert encoder.weight.grad is not None and encoder.weight.grad.abs().sum() > 0


def test_recurrent_layers_read_pictures_step_by_step_as_in_sequences():
    make, options = (
        (lambda cfg, **sizes: make_recurrent_actor(RecurrentCfg(hidden_dim=3), cfg, **sizes)),
        ACTION,
    )
    actor = network(make, ActorCfg, **options)
    update_normalizers(observations(2, E), actor)
    steps = observations(E, 4)
    steps["is_init"] = torch.zeros(E, 4, 1, dtype=torch.bool)
    for part in ("h", "c"):
        steps["recurrent_state", "actor", part] = torch.zeros(E, 4, 1, 3)
    with set_recurrent_mode(True):
        loc_ET = actor(steps.clone())["loc"]
    step = steps[:, 0].clone()
    for t in range(4):
        out = actor(step)
        torch.testing.assert_close(out["loc"], loc_ET[:, t])
        if t < 3:
            step = steps[:, t + 1].clone()
            step["recurrent_state"] = out["next", "recurrent_state"]


def test_pictures_alone_leave_nothing_to_normalize():
    actor = network(make_actor, ActorCfg, in_keys=("rgb",), **ACTION)
    assert not any(getattr(part, "normalizer", None) for part in actor.modules())
    update_normalizers(observations(2, E), actor)


@pytest.mark.parametrize(
    ("keys", "encoders", "message"),
    [
        (
            ("rgb",),
            {},
            r"'rgb' is no vector.*uint8 of shape \[9, 8, 3\].*`encoders: \{rgb: \{\}\}`",
        ),
        (("joints", "depth"), {}, r"'depth' is no vector.*\[9, 8\]"),
        (("joints",), {"joints": SMALL}, r"encoders\.joints: it reads pictures.*these are \[4\]"),
        (("wrist",), {"wrist": SMALL}, r"encoders\.wrist: .*no observation 'wrist'"),
        (("rgb",), {"rgb": EncoderCfg()}, "cannot map two of them: .*Kernel size"),
    ],
)
def test_what_a_network_cannot_read_is_refused(keys, encoders, message):
    cfg = ActorCfg(in_keys=keys, encoders=encoders)
    with pytest.raises(ValueError, match=message):
        make_for_spec(make_actor, cfg, SPEC, action_spec=Unbounded(2))


@pytest.mark.parametrize(
    ("shape", "dtype", "message"),
    [
        ((H, W, 3), torch.int32, "torch.int32"),
        # Frames of a depth camera would be taken for rows.
        ((3, H, W), torch.float32, r"stacked \[N, H, W\]"),
        ((3,), torch.uint8, r"these are \[3\]"),
    ],
)
def test_pictures_that_would_be_misread_are_refused(shape, dtype, message):
    with pytest.raises(ValueError, match=message):
        Encoder(SMALL, picture_spec(*shape, dtype=dtype))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"channels": ()}, r"channels=\(\)"),
        ({"strides": (2, 2)}, r"strides=\(2, 2\): expected 3 numbers"),
        ({"value_range": (1.0, 1.0)}, "expected low < high"),
        ({"activation": "rel"}, "did you mean 'relu'"),
    ],
)
def test_settings_that_fit_nothing_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        EncoderCfg(**fields)


def test_encoders_are_of_what_is_read_and_pictures_reach_no_network_without():
    with pytest.raises(ValueError, match="encoders='rgb'"):
        ActorCfg(in_keys=("joints",), encoders={"rgb": SMALL})
    with pytest.raises(ValueError, match="`make_for_spec` puts encoders in front"):
        make_critic(CriticCfg(in_keys=("rgb",), encoders={"rgb": SMALL}), obs_dim=3)
    # Three numbers per pixel, and a network for three numbers.
    actor = make_actor(ActorCfg(in_keys=("rgb",)), obs_dim=3, action_dim=2)
    with pytest.raises(ValueError, match=r"no uint8 of shape \[6, 9, 8, 3\]"):
        actor(observations(E))
    # An observation of the env that has the name of features.
    taken = SPEC.clone()
    taken["encoded", "rgb"] = Unbounded((E, 4))
    with pytest.raises(ValueError, match="has an observation 'encoded', where networks write"):
        make_for_spec(make_critic, CriticCfg(in_keys=("rgb",), encoders={"rgb": SMALL}), taken)
    # Pictures of another size than the encoder's.
    built = network(make_actor, ActorCfg, in_keys=("rgb",), **ACTION)
    with pytest.raises(ValueError, match=r"built for pictures \[9, 8, 3\]"):
        built(TensorDict({"rgb": torch.zeros(E, W, H, 3, dtype=torch.uint8)}, [E]))
    # Floats in [0, 1] would be divided by 255 as bytes are.
    with pytest.raises(ValueError, match=r"of torch.uint8, and reads .* of torch.float32"):
        built(TensorDict({"rgb": torch.zeros(E, H, W, 3)}, [E]))
