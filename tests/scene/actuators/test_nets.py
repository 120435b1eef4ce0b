"""Learned motor models against the torch modules whose weights they load, and files that do not fit."""

import hashlib
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from ksim_rl.scene.actuators import LSTMActuator, MLPActuator
from tests.scene.actuators.chain import (
    JOINTS,
    LSTM_SIZE,
    MLP_LAGS,
    ChainBench,
    feed_forward_module,
    recurrent_module,
    written,
)

NUM_SUBSTEPS, ROWS = 7, 3
MLP_METADATA = {"activation": "softsign", "input_lags": "[0, 2, 3]"}


def drive(bench, joints, seed=0, num_substeps=NUM_SUBSTEPS):
    """Lead two joints through random states; return errors, velocities and efforts [E, N, T]."""
    generator = torch.Generator().manual_seed(seed)
    columns = [JOINTS.index(name) for name in joints]
    motors = [bench.world.mj_model.actuator(name).id for name in joints]
    errors, velocities, efforts = [], [], []
    for _ in range(num_substeps):
        state = torch.randn(4, ROWS, 2, generator=generator)
        bench.world.qpos_EL[:, columns], bench.world.qvel_EL[:, columns] = state[0], 5.0 * state[1]
        bench.view.write_joint_pos_target(joints, state[2])
        bench.efforts(joints[0])
        errors.append(state[2] - state[0])
        velocities.append(5.0 * state[1])
        efforts.append(bench.world.ctrl_EL[:, motors].clone())
    return tuple(torch.stack(values, dim=-1) for values in (errors, velocities, efforts))


@pytest.fixture(scope="module")
def lstm(tmp_path_factory):
    module, folder = recurrent_module(), tmp_path_factory.mktemp("lstm")
    file = written(module, folder, velocity_scale="0.2", effort_scale="30")
    fields = {"position_scale": 2.0, "effort_limit": 2.0}
    return module, ChainBench(
        LSTMActuator(joints=("elbow", "wrist"), file=file, **fields), num_envs=ROWS
    )


@pytest.fixture(scope="module")
def mlp(tmp_path_factory):
    module = feed_forward_module()
    file = written(module, tmp_path_factory.mktemp("mlp"))
    actuator = MLPActuator(
        joints=("elbow", "wrist"),
        file=file,
        sha256=hashlib.sha256(Path(file).read_bytes()).hexdigest(),
        activation="softsign",
        input_lags=MLP_LAGS,
        velocity_scale=0.1,
        effort_scale=20.0,
        effort_limit=2.0,
    )
    return module, ChainBench(actuator, num_envs=ROWS)


def recurrent_answer(module, errors_ENT, velocities_ENT):
    inputs = torch.stack((2.0 * errors_ENT, 0.2 * velocities_ENT), dim=-1)
    return (30.0 * module(inputs.flatten(0, 1)).unflatten(0, (ROWS, 2))).clamp(-2.0, 2.0)


def feed_forward_answer(module, errors_ENT, velocities_ENT):
    answers = []
    for t in range(errors_ENT.shape[-1]):
        past = [max(0, t - lag) for lag in MLP_LAGS]
        inputs = torch.cat((errors_ENT[..., past], 0.1 * velocities_ENT[..., past]), dim=-1)
        answers.append((20.0 * module(inputs)[..., 0]).clamp(-2.0, 2.0))
    return torch.stack(answers, dim=-1)


@pytest.mark.parametrize(
    ("kind", "answer"), [("lstm", recurrent_answer), ("mlp", feed_forward_answer)]
)
def test_efforts_are_those_of_the_torch_module_and_start_anew_after_a_reset(request, kind, answer):
    module, bench = request.getfixturevalue(kind)
    bench.reset(0, 1, 2)
    errors, velocities, efforts = drive(bench, ("elbow", "wrist"))
    expected = answer(module, errors, velocities)
    torch.testing.assert_close(efforts, expected, atol=1e-4, rtol=1e-4)
    bound = expected.abs().max()
    assert (expected.abs() == bound).sum() > 1, "the limit was reached"
    assert (expected.abs() < bound).sum() > 10, "and not all the time"

    bench.reset(1)
    later = drive(bench, ("elbow", "wrist"), seed=1)
    whole = [torch.cat(pair, dim=-1) for pair in zip((errors, velocities), later[:2], strict=True)]
    torch.testing.assert_close(
        later[2][[0, 2]], answer(module, *whole)[[0, 2], :, NUM_SUBSTEPS:], atol=1e-4, rtol=1e-4
    )
    torch.testing.assert_close(later[2][1], answer(module, *later[:2])[1], atol=1e-4, rtol=1e-4)


def test_scales_of_the_config_come_before_those_of_the_file(tmp_path):
    file = written(feed_forward_module(), tmp_path, effort_scale="20", **MLP_METADATA)
    one, other = (
        ChainBench(MLPActuator(joints="elbow", file=file, effort_scale=scale), num_envs=ROWS)
        for scale in (None, 10.0)
    )
    for bench in (one, other):
        bench.move("elbow", pos=0.3, vel=1.0)
    torch.testing.assert_close(one.efforts("elbow"), 2.0 * other.efforts("elbow"))


def changed(file: str, change, **metadata: str) -> None:
    """Rewrite a file with some tensors changed, and with this metadata."""
    tensors = load_file(file)
    change(tensors)
    save_file(
        {name: tensor.contiguous() for name, tensor in tensors.items()},
        file,
        metadata=metadata or None,
    )


def nothing(tensors) -> None:
    """Change nothing."""


@pytest.mark.parametrize(
    ("metadata", "change", "message"),
    [
        ({"input_lags": "[0, 2, 3]"}, nothing, "no 'activation' in its metadata: give the field"),
        ({"activation": "softsign"}, nothing, "no 'input_lags' in its metadata"),
        (MLP_METADATA | {"activation": "swish"}, nothing, "activation='swish'.*elu"),
        (MLP_METADATA | {"input_lags": "0, 2"}, nothing, "input_lags='0, 2' in its metadata"),
        (MLP_METADATA | {"input_lags": "[0, -2, 3]"}, nothing, r"input_lags\[1\]=-2"),
        (
            MLP_METADATA | {"input_lags": "[0, 2]"},
            nothing,
            r"0\.weight has shape \(8, 6\): expected \(any, 4\)",
        ),
        (MLP_METADATA | {"effort_scale": "much"}, nothing, "effort_scale='much'.*number"),
        (MLP_METADATA | {"effort_scale": "nan"}, nothing, "effort_scale=nan"),
        (MLP_METADATA, lambda t: t.update({"2.bias": torch.zeros(3)}), r"2\.bias has shape \(3,\)"),
        (MLP_METADATA, lambda t: t.pop("2.bias"), r"no tensor '2\.bias'"),
        (
            MLP_METADATA,
            lambda t: t.update({"4.weight": torch.zeros(2, 6)}),
            r"4\.weight.*expected \(1, 6\)",
        ),
        (
            MLP_METADATA,
            lambda t: t["0.bias"].fill_(torch.nan),
            r"0\.bias holds numbers that are not finite",
        ),
        (MLP_METADATA, lambda t: t.update(norm=torch.zeros(1)), r"unknown tensors \['norm'\]"),
        (MLP_METADATA, lambda t: t.clear(), r"no tensor '0\.weight'"),
    ],
)
def test_a_feed_forward_file_that_does_not_fit_is_refused_in_one_line(
    tmp_path, metadata, change, message
):
    file = written(feed_forward_module(), tmp_path)
    changed(file, change, **metadata)
    refused(MLPActuator(joints="elbow", file=file), message, file)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("lstm.bias_hh_l1"), r"no tensor 'lstm\.bias_hh_l1'"),
        (lambda t: t.pop("head.bias"), r"no tensor 'head\.bias'"),
        (
            lambda t: t.update({"lstm.weight_ih_l0": torch.zeros(4 * LSTM_SIZE, 3)}),
            r"weight_ih_l0.*\(20, 2\)",
        ),
        (
            lambda t: t.update({"head.weight": torch.zeros(1, 4)}),
            r"head\.weight.*expected \(1, 5\)",
        ),
        (lambda t: t.update(norm=torch.zeros(1)), r"unknown tensors \['norm'\]"),
        (lambda t: t.clear(), r"no tensor 'lstm\.weight_hh_l0'"),
    ],
)
def test_a_recurrent_file_that_does_not_fit_is_refused_in_one_line(tmp_path, change, message):
    file = written(recurrent_module(), tmp_path)
    changed(file, change)
    refused(LSTMActuator(joints="elbow", file=file), message, file)


def refused(actuator, message: str, file: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        actuator.law(None)
    text = str(error.value)
    assert "\n" not in text
    assert file in text and hashlib.sha256(Path(file).read_bytes()).hexdigest() in text


def test_missing_damaged_and_other_files_are_told_apart(tmp_path):
    file = written(recurrent_module(), tmp_path)
    with pytest.raises(ValueError, match=r"none\.safetensors.*No such file"):
        LSTMActuator(joints="elbow", file=str(tmp_path / "none.safetensors")).law(None)
    with pytest.raises(ValueError, match="expected sha256='00'.*another one"):
        LSTMActuator(joints="elbow", file=file, sha256="00").law(None)
    pickled = tmp_path / "lstm.pt"
    torch.save(nn.LSTM(2, 3).state_dict(), pickled)
    with pytest.raises(ValueError, match="no safetensors file"):
        LSTMActuator(joints="elbow", file=str(pickled)).law(None)
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(Path(file).read_bytes()[:-8])
    with pytest.raises(ValueError, match="no safetensors file"):
        LSTMActuator(joints="elbow", file=str(cut)).law(None)
