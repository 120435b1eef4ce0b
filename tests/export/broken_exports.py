"""Exports of a quadruped that are broken, each in one way, with the cause that should be found first."""

import json
from xml.etree import ElementTree

import numpy as np
import onnx


def change_json(folder, edit):
    path = folder / "export.json"
    meta = json.loads(path.read_text())
    edit(meta, {term["name"]: term for term in meta["observations"]})
    path.write_text(json.dumps(meta))


def change_xml(folder, edit):
    path = folder / "robot.xml"
    root = ElementTree.fromstring(path.read_text())
    edit(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode"))


def measured(meta, name):
    """The entry of a measurement that observations read."""
    (found,) = [one for one in meta["obs"]["measurements"] if one["input"] == name]
    return found


def observed_order(folder):
    def edit(meta, _):
        names = measured(meta, "joint_vel")["joints"]
        names[0], names[5] = names[5], names[0]

    change_json(folder, edit)


def actuator_order(folder):
    def edit(root):
        one, other = list(root.find("actuator"))[:2]
        joint = one.get("joint")
        one.set("joint", other.get("joint"))
        other.set("joint", joint)

    change_xml(folder, edit)


def gain(folder):
    def edit(root):
        for actuator in root.find("actuator"):
            for field in ("gainprm", "biasprm"):
                halved = [str(0.5 * float(x)) for x in actuator.get(field).split()]
                actuator.set(field, " ".join(halved))

    change_xml(folder, edit)


def delay(folder):
    def edit(meta, _):
        (lag,) = meta["action_chain"]
        lag["min"] = lag["max"] = 4

    change_json(folder, edit)


def frame(folder):
    def edit(meta, terms):
        body = measured(meta, "projected_gravity")["body"]
        (name,) = terms["base_lin_vel"]["reads"]
        one = measured(meta, name)
        one.clear()
        one.update(input=name, quantity="root_lin_vel", body=body, frame="world")

    change_json(folder, edit)


def rate(folder):
    change_json(folder, lambda meta, _: meta.update(decimation=2))


def scale(folder):
    change_json(folder, lambda _, terms: terms["base_ang_vel"].update(scale=[0.25] * 3))


def action_scale(folder):
    change_json(folder, lambda meta, _: meta["actions"][0].update(scale=1.0))


def normalizer(folder):
    model = onnx.load(folder / "policy.onnx")
    for tensor in model.graph.initializer:
        if tensor.name.endswith("normalizer.mean"):
            zeros = np.zeros(onnx.numpy_helper.to_array(tensor).shape, np.float32)
            tensor.CopyFrom(onnx.numpy_helper.from_array(zeros, tensor.name))
            break
    else:
        raise AssertionError([tensor.name for tensor in model.graph.initializer])
    onnx.save(model, folder / "policy.onnx")


def stale_sensor(folder):
    late = {
        "min": 1,
        "max": 1,
        "resample_every": 0,
        "hold_probability": 0.0,
        "shared": None,
        "initial": None,
    }
    change_json(folder, lambda _, terms: terms["base_ang_vel"].update(delay=late))


def contact_parameters(folder):
    def edit(root):
        for geom in root.iter("geom"):
            geom.set("solref", "0.2 1")

    change_xml(folder, edit)


def mass(folder):
    def edit(root):
        for body in root.iter("body"):
            for owner in (*body.findall("inertial"), *body.findall("geom")):
                if owner.get("mass"):
                    owner.set("mass", str(1.5 * float(owner.get("mass"))))

    change_xml(folder, edit)


BREAKS = {
    observed_order: "joint order",
    actuator_order: "joint order",
    gain: "gain",
    delay: "delay",
    frame: "frame",
    rate: "rate",
    scale: "scale",
    action_scale: "scale",
    normalizer: "normalizer",
    stale_sensor: "stale sensor",
    contact_parameters: "contact parameters",
    mass: "mass or inertia",
}
