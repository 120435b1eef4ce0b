"""No malformed model ends the process or holds it up: each is one line that names the file."""

import mujoco
import pytest

from benchmarks.agreement_models import CARTPOLE
from ksim_rl.physics import SimCfg, load_model, load_spec, model_checks, model_size
from tests.physics import malformed_kinds
from tests.physics.malformed_models import JOINTED, body


def check(figures):
    assert figures["which"] == {}
    assert figures["crashes"] == figures["hangs"] == figures["accepted"] == 0


def test_a_sample_of_the_kinds_is_refused_in_one_line():
    names = [*list(malformed_kinds.kinds())[5::14], "50000000 replicas", "attached in itself"]
    assert len(names) >= 20
    check(malformed_kinds.figures(names))


@pytest.mark.full
def test_all_kinds_are_refused_in_one_line():
    figures = malformed_kinds.figures()
    assert figures["kinds"] >= 150
    check(figures)


def test_the_count_tells_crashes_and_what_is_accepted(monkeypatch):
    def load_as_mujoco_does(path):
        return mujoco.MjModel.from_xml_path(str(path))

    found = malformed_kinds.figures(
        ["attached in itself", "time step of a second"], load=load_as_mujoco_does
    )
    assert (found["crashes"], found["accepted"]) == (1, 1)


def test_the_count_tells_what_hangs(monkeypatch):
    def spin(path):
        while True:
            pass

    monkeypatch.setattr(malformed_kinds, "MOST_SECONDS", 0.2)
    assert malformed_kinds.figures(["another root"], load=spin)["hangs"] == 1


def test_the_base_of_the_generated_kinds_is_a_good_model():
    assert load_model(malformed_kinds.FULL).nu == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ('timestep="0.01"', "option.timestep=0.2 .* expected"),
        ('kp="-1"', "actuator_gainprm=-1 in actuator 'servo'"),
    ],
)
def test_what_nobody_means_names_element_and_bound(change, words):
    servo = body(JOINTED, f'<actuator><position name="servo" joint="hinge" {change}/></actuator>')
    xml = CARTPOLE.replace(change, 'timestep="0.2"') if "timestep" in change else servo
    with pytest.raises(ValueError, match=words):
        load_model(xml)


def test_a_time_step_that_the_settings_mend_is_taken():
    xml = malformed_kinds.FULL.replace('timestep="0.002"', 'timestep="1"')
    assert load_model(xml, SimCfg(timestep=0.005)).opt.timestep == 0.005


def test_a_callback_lets_user_types_pass(monkeypatch):
    xml = body(JOINTED, '<actuator><general name="push" joint="hinge" gaintype="user"/></actuator>')
    with pytest.raises(ValueError, match="'push': it needs a callback"):
        load_model(xml)
    monkeypatch.setitem(model_checks.CALLBACKS, "gain", lambda: print)
    assert load_model(xml).nu == 1


def test_the_limit_can_be_raised_and_lowered(monkeypatch):
    xml = '<mujoco><asset><hfield name="a" nrow="40" ncol="40" size="1 1 1 1"/></asset></mujoco>'
    load_model(xml)
    monkeypatch.setenv(model_size.VARIABLE, "1000")
    with pytest.raises(
        ValueError, match=r"raise the environment variable KSIM_RL_LARGEST_MODEL to 1600.*now 1000"
    ):
        load_model(xml)
    monkeypatch.setenv(model_size.VARIABLE, "1600")
    load_model(xml)
    monkeypatch.setenv(model_size.VARIABLE, "many")
    with pytest.raises(ValueError, match="KSIM_RL_LARGEST_MODEL='many': expected a whole number"):
        load_model(xml)


def test_a_spec_that_breaks_while_it_compiles_names_its_file(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(CARTPOLE)
    spec = load_spec(path)
    spec.worldbody.add_body(name="loose").add_freejoint()
    with pytest.raises(ValueError, match=r"robot\.xml: .*'loose'"):
        load_model(spec)
