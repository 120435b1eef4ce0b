"""Every field of mjOption, array of mjModel and value of its enums is listed once: what a new version adds fails."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest

from ksim_rl.physics import World, load_model
from tests.physics import every_array, every_enum

ROOT = Path(__file__).parents[2]
ENUMS = sorted(every_enum.HONOURED)
SLIDER = '<body name="b"><joint name="j" type="slide"/><geom size=".1"/></body>'
BALL = '<body name="b"><joint name="j" type="ball"/><geom size=".1"/></body>'
WITH_SITE = '<body><joint/><geom size=".1"/><site name="s"/></body>'
_SETTINGS = {"size": "3 3", "fov": "30 30", "gamma": "0", "nchannel": "1"}
_CONFIG = "".join(f'<config key="{key}" value="{value}"/>' for key, value in _SETTINGS.items())
TOUCH_GRID = (
    '<extension><plugin plugin="mujoco.sensor.touch_grid"/></extension><sensor>'
    f'<plugin plugin="mujoco.sensor.touch_grid" objtype="site" objname="s">{_CONFIG}</plugin></sensor>'
)
WORLD = "<mujoco>{option}<worldbody>{bodies}</worldbody>{more}</mujoco>"


def model(*, option: str = "", bodies: str = SLIDER, more: str = "") -> str:
    return WORLD.format(option=option, bodies=bodies, more=more)


def actuator(text: str, bodies: str = SLIDER) -> str:
    return model(bodies=bodies, more=f"<actuator>{text}</actuator>")


def flag(name: str, setting: str) -> str:
    return model(option=f'<option><flag {name}="{setting}"/></option>')


def sleeping(policy: str) -> str:
    return flag("sleep", "enable").replace("<body ", f'<body sleep="{policy}" ')


# What is refused, and what the message names.
MODELS = {
    "mjtTrn SO3": (actuator('<orientation joint="j" kp="1"/>', BALL), "mjTRN_SO3.*actuator"),
    "mjtGain SO3": (actuator('<orientation joint="j" kp="1"/>', BALL), "mjTRN_SO3|mjGAIN_SO3"),
    "mjtBias SO3": (actuator('<orientation joint="j" kp="1"/>', BALL), "mjTRN_SO3|mjBIAS_SO3"),
    "mjtDyn PID": (actuator('<pid joint="j" kp="1" ki="1"/>'), "mjDYN_PID.*actuator"),
    "mjtGain PID": (actuator('<pid joint="j" kp="1"/>'), "mjGAIN_PID.*actuator"),
    "mjtDyn USER": (actuator('<general joint="j" dyntype="user"/>'), "dyntype='user'.*callback"),
    "mjtGain USER": (actuator('<general joint="j" gaintype="user"/>'), "gaintype='user'.*callback"),
    "mjtBias USER": (actuator('<general joint="j" biastype="user"/>'), "biastype='user'.*callback"),
    "mjtSolver PGS": (model(option='<option solver="PGS"/>'), "mjSOL_PGS"),
    "mjtDisableBit MIDPHASE": (flag("midphase", "disable"), "mjDSBL_MIDPHASE"),
    "mjtDisableBit AUTORESET": (flag("autoreset", "disable"), "mjDSBL_AUTORESET"),
    "mjtEnableBit OVERRIDE": (flag("override", "enable"), "mjENBL_OVERRIDE"),
    "mjtEnableBit FWDINV": (flag("fwdinv", "enable"), "mjENBL_FWDINV"),
    "mjtEnableBit DIAGEXACT": (flag("diagexact", "enable"), "mjENBL_DIAGEXACT"),
    "mjtEnableBit SPECULATIVE": (flag("speculative", "enable"), "mjENBL_SPECULATIVE"),
    "mjtEnableBit IPC": (
        model(option='<option integrator="discrete"><flag ipc="enable"/></option>'),
        "mjENBL_IPC",
    ),
    "mjtSleepPolicy NEVER": (sleeping("never"), "mjSLEEP_NEVER"),
    "mjtSleepPolicy ALLOWED": (sleeping("allowed"), "mjSLEEP_ALLOWED"),
    "mjtSleepPolicy INIT": (sleeping("init"), "mjSLEEP_INIT"),
    "mjtSensor PLUGIN": (model(bodies=WITH_SITE, more=TOUCH_GRID), "mjSENS_PLUGIN.*sensor"),
}
# Of which no XML makes a model: C has dropped the one, and a vertex is tied by no element of its own.
OF_NO_XML = {"mjtEq DISTANCE", "mjtEq FLEXVERT"}
PLUGINS = {
    "actuator": (
        model(
            bodies=SLIDER,
            more='<extension><plugin plugin="mujoco.pid"><instance name="p"><config key="kp" value="1"/></instance>'
            '</plugin></extension><actuator><plugin joint="j" plugin="mujoco.pid" instance="p"/></actuator>',
        ),
        "Actuator plugins not supported.*actuator",
    ),
    "sensor": MODELS["mjtSensor PLUGIN"],
}


def words(blocks: Mapping[str, str]) -> list[str]:
    return [word for block in blocks.values() for word in block.split()]


def values(enum: str) -> set[str]:
    """The values of an enum without their prefix and without the count of them."""
    names = [name for name in getattr(mujoco, enum).__members__ if not name.startswith("mjN")]
    return {name.partition("_")[2] for name in names}


def test_every_array_of_a_model_is_listed_once():
    mj_model = mujoco.MjModel.from_xml_string("<mujoco/>")
    arrays = [name for name in dir(mj_model) if not name.startswith("_")]
    arrays = [name for name in arrays if isinstance(getattr(mj_model, name), np.ndarray)]
    lists = (
        every_array.HONOURED,
        every_array.REFUSED,
        every_array.WITHOUT_MEANING,
        every_array.NOT_COMPARED,
    )
    listed = [word for blocks in lists for word in words(blocks)]
    assert Counter(listed) == Counter(arrays)


def test_every_field_of_the_options_is_listed_once():
    options = [name for name in dir(mujoco.MjOption) if not name.startswith("_")]
    lists = (every_enum.OPTIONS_HONOURED, every_enum.OPTIONS_REFUSED)
    listed = [word for blocks in lists for word in words(blocks)]
    assert Counter(listed) == Counter(options)


@pytest.mark.parametrize("enum", ENUMS)
def test_every_value_of_an_enum_is_listed_once(enum: str):
    others = (every_enum.REFUSED, every_enum.WITHOUT_MEANING)
    listed = words(every_enum.HONOURED[enum])
    for blocks in others:
        listed += blocks.get(enum, "").split()
    assert Counter(listed) == Counter(values(enum))


def test_what_shows_it_is_there():
    shown = {*every_array.HONOURED, *every_enum.OPTIONS_HONOURED}
    shown |= {test for tests in every_enum.HONOURED.values() for test in tests}
    for test in shown:
        path, _, function = test.partition("::")
        assert (ROOT / path).is_file(), test
        assert f"def {function}" in (ROOT / path).read_text(), test


def test_what_is_refused_has_a_model():
    refused = {
        f"{enum} {value}" for enum, block in every_enum.REFUSED.items() for value in block.split()
    }
    assert refused == {*MODELS, *OF_NO_XML}


@pytest.mark.parametrize("what", MODELS)
def test_it_is_refused_by_name(what: str):
    xml, named = MODELS[what]
    with pytest.raises(ValueError, match=named):
        World(load_model(xml), num_envs=1)


@pytest.mark.parametrize("what", PLUGINS)
def test_plugins_are_refused_by_name(what: str):
    xml, named = PLUGINS[what]
    with pytest.raises(ValueError, match=named):
        load_model(xml)


def test_flags_are_named_also_where_there_are_several():
    xml = model(
        option='<option><flag override="enable" speculative="enable" midphase="disable"/></option>'
    )
    with pytest.raises(
        ValueError, match="mjDSBL_MIDPHASE, mjENBL_OVERRIDE, mjENBL_SPECULATIVE are unsupported"
    ):
        load_model(xml)


def test_settings_of_override_do_nothing_without_it():
    plain = mujoco.MjModel.from_xml_string(model())
    xml = model(option='<option o_margin="0.1" o_solref="0.1 1" o_friction="1 1 1 1 1"/>')
    set_so = mujoco.MjModel.from_xml_string(xml)
    states = []
    for mj_model in (plain, set_so):
        world = World(mj_model, num_envs=1)
        world.qvel_EL.fill_(1.0)
        world.step(3)
        states.append(world.qpos_EL.clone())
    assert bool((states[0] == states[1]).all())
