"""Names the quantities that terms read of a robot and its world, which other programs measure or estimate.

Each is a node of `export.json`: `{"quantity": name, ...}` with the names of the joints, bodies or sites in question.
`standalone/signals.py` reads the same quantities from MuJoCo's C engine.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.export.standalone.files import Json
from ksim_rl.export.standalone.signals import ARRAYS
from ksim_rl.scene.sensors import ContactTracker
from ksim_rl.scene.state.elements import Bodies, Joints, Sites
from ksim_rl.scene.state.entity import Entity, GroundScan
from ksim_rl.scene.state.world_view import WorldView

# The kinds of the view's parts that have quantities, each with a cache of its own.
Part: TypeAlias = Joints | Bodies | Sites | Entity | GroundScan | WorldView
# How a measurement is read again, in another env of the same task.
Reader: TypeAlias = Callable[[EnvView], Tensor]

# The quantities of joints, bodies and sites, as `export.json` calls them.
_OF_ELEMENTS: dict[type[Joints | Bodies | Sites], dict[str, str]] = {
    Joints: {
        "pos_EL": "joint_pos",
        "pos_rel_EL": "joint_pos_rel",
        "vel_EL": "joint_vel",
        "acc_EL": "joint_acc",
        "effort_EL": "joint_effort",
    },
    Bodies: {
        "pos_EN3": "body_pos",
        "quat_EN4": "body_quat",
        "axes_EN33": "body_axes",
        "lin_vel_EN3": "body_lin_vel",
        "ang_vel_EN3": "body_ang_vel",
        "subtree_com_pos_EN3": "com_pos",
    },
    Sites: {
        "pos_EN3": "site_pos",
        "axes_EN33": "site_axes",
        "height_EN": "site_height",
        "lin_vel_EN3": "site_lin_vel",
    },
}
_KINDS = {Joints: "joints", Bodies: "bodies", Sites: "sites"}
# The quantities of an entity's root; those with a frame are given in the root's axes or in the world's.
_OF_ROOT: dict[str, dict[str, str]] = {
    "root_pos_EL": {"quantity": "root_pos"},
    "root_quat_EL": {"quantity": "root_quat"},
    "root_height_E": {"quantity": "root_height"},
    "projected_gravity_EL": {"quantity": "projected_gravity"},
    "root_lin_vel_b_EL": {"quantity": "root_lin_vel", "frame": "root"},
    "root_lin_vel_w_EL": {"quantity": "root_lin_vel", "frame": "world"},
    "root_ang_vel_b_EL": {"quantity": "root_ang_vel", "frame": "root"},
    "root_ang_vel_w_EL": {"quantity": "root_ang_vel", "frame": "world"},
}
# Arrays with an entry per actuator, which the exported model has in the order of the actions.
OF_ACTUATORS = ("actuator_force", "ctrl")


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """A quantity that a term may read: its node in `export.json`, its numbers [E, ...], and how to read it again."""

    node: Json
    value: Shaped[Tensor, " E *leaf"]
    read: Reader


def measurements(view: EnvView) -> Iterator[Measurement]:
    """Yield the quantities that terms have read in the current state, and those that are always there."""
    yield from _of_parts(view)
    yield from _of_sensors(view)
    yield from _of_managers(view)
    yield from _of_worlds(view)


def forget_others(view: EnvView) -> None:
    """Empty the view's caches of all that is no measurement, so that terms compute it again.

    What is measured stays, so that a second reading gives the same tensor as the first.
    """
    for part in parts(view):
        measured = _measured_by(part)
        for name in [name for name in part.cache if name not in measured]:
            del part.cache[name]
    view.command_cache.clear()


def seen_by_rays(view: EnvView) -> list[str]:
    """Return the cameras and ray casters that terms have read in the current state."""
    kinds = {"rays": "the ray caster", "camera": "the camera"}
    found = [key.partition("/") for key in view.cache]
    return [f"{kinds[kind]} {name.partition('.')[0]!r}" for kind, _, name in found if kind in kinds]


def parts(view: EnvView) -> list[Part]:
    """Return the parts of the view that compute quantities."""
    found: list[Part] = [part for part in view.parts().values() if isinstance(part, Part)]
    for entity in view.entities.values():
        found += [entity.root_bodies, entity.joints, *entity.ground_scans]
    return found


def _measured_by(part: Part) -> set[str]:
    """Return the keys of a part's cache that are measurements."""
    if isinstance(part, WorldView):
        return {
            key
            for key in part.cache
            if key == "episode_time_E" or key.startswith(("sensor/", "contact/"))
        }
    if isinstance(part, Entity):
        return set(_OF_ROOT)
    if isinstance(part, GroundScan):
        return {"below_EN"}
    return set(_OF_ELEMENTS[type(part)])


def _exactly(names: Sequence[str]) -> list[str]:
    """Return patterns that match these names and no others."""
    return [re.escape(name) for name in names]


def _again(kind: str, names: Sequence[str], attribute: str) -> Reader:
    """Return the reader of a quantity of joints, bodies or sites."""

    def read(view: EnvView) -> Tensor:
        return getattr(getattr(view, kind)(_exactly(names)), attribute)

    return read


def _of_parts(view: EnvView) -> Iterator[Measurement]:
    for entity in view.entities.values():
        yield from _of_entity(entity)
    for part in parts(view):
        if isinstance(part, Joints | Bodies | Sites):
            kind = _KINDS[type(part)]
            for attribute, name in _OF_ELEMENTS[type(part)].items():
                if attribute in part.cache:
                    node = {"quantity": name, kind: list(part.names)}
                    read = _again(kind, part.names, attribute)
                    yield Measurement(node=node, value=part.cache[attribute], read=read)


def _of_entity(entity: Entity) -> Iterator[Measurement]:
    root = entity.root.name
    for attribute, node in _OF_ROOT.items():
        if attribute in entity.cache:
            read = _of_same_entity(entity.name, attribute)
            yield Measurement(node={**node, "body": root}, value=entity.cache[attribute], read=read)
    for scan in entity.ground_scans:
        if "below_EN" in scan.cache:
            node = {
                "quantity": "ground_below",
                "body": root,
                "points": [list(point) for point in scan.points],
            }
            read = _of_same_scan(entity.name, scan.points)
            yield Measurement(node=node, value=scan.cache["below_EN"], read=read)


def _of_same_entity(name: str, attribute: str) -> Reader:
    return lambda view: getattr(view.entity(name), attribute)


def _of_same_scan(name: str, points: tuple[tuple[float, float], ...]) -> Reader:
    return lambda view: view.entity(name).ground_scan(points).below_EN


def _of_sensors(view: EnvView) -> Iterator[Measurement]:
    for key, value in view.cache.items():
        kind, _, name = key.partition("/")
        if kind == "sensor":
            yield Measurement(
                node={"quantity": "sensor", "sensor": name}, value=value, read=_of_same_sensor(name)
            )
    for name, tracker in view.sensors.items():
        if isinstance(tracker, ContactTracker):
            for field, value in tracker.state._asdict().items():
                # `found_EN` is `found` to those who do not know the letters of dims.
                node = {"quantity": "contact", "sensor": name, "field": field.rpartition("_")[0]}
                yield Measurement(node=node, value=value, read=_of_same_contact(name, field))
    kept = view.buffers.by_name()
    for part in parts(view):
        # Kept by the env, since it belongs to a moment that is over.
        name = f"of_contacts/sites {list(part.ids)}" if isinstance(part, Sites) else ""
        if isinstance(part, Sites) and name in kept:
            node = {"quantity": "site_lin_vel_of_contacts", "sites": list(part.names)}
            read = _again("sites", part.names, "lin_vel_of_contacts_EN3")
            yield Measurement(node=node, value=kept[name], read=read)


def _of_same_sensor(name: str) -> Reader:
    return lambda view: view.sensor(name)


def _of_same_contact(name: str, field: str) -> Reader:
    return lambda view: getattr(view.contact(name), field)


def _of_managers(view: EnvView) -> Iterator[Measurement]:
    """Yield actions, commands, times and tables of joints, which the view has in every state."""
    for name, value in view.commands.items():
        yield Measurement(
            node={"quantity": "command", "command": name}, value=value, read=_of_same_command(name)
        )
    own: dict[str, Reader] = {
        "action": lambda view: view.action_EL,
        "last_action": lambda view: view.last_action_EL,
        "terminated": lambda view: view.terminated_E,
        "step": lambda view: view.episode_step_E,
        "time_out_offset": lambda view: view.time_out_offset_E,
    }
    for name, read in own.items():
        yield Measurement(node={"quantity": name}, value=read(view), read=read)
    if "episode_time_E" in view.cache:
        yield Measurement(
            node={"quantity": "time"},
            value=view.cache["episode_time_E"],
            read=lambda view: view.episode_time_E,
        )
    of_joints: dict[str, Reader] = {
        "default_joint_pos": lambda view: view.default_joint_pos_EL,
        "encoder_bias": lambda view: view.encoder_bias_EL,
        "joint_pos_target": lambda view: view.joint_pos_target_EL,
        "joint_vel_target": lambda view: view.joint_vel_target_EL,
        "joint_effort_target": lambda view: view.joint_effort_target_EL,
    }
    names = list(view.joints().names)
    for name, read in of_joints.items():
        yield Measurement(node={"quantity": name, "joints": names}, value=read(view), read=read)


def _of_same_command(name: str) -> Reader:
    return lambda view: view.command(name)


def _of_worlds(view: EnvView) -> Iterator[Measurement]:
    shown = view.world.views()
    for name in ARRAYS:
        if name in shown:
            yield Measurement(
                node={"quantity": "data", "field": name},
                value=shown[name],
                read=_of_same_array(name),
            )
    actuators = view.resolver.names("actuator")
    for name in OF_ACTUATORS:
        if name in shown:
            node = {"quantity": name, "actuators": actuators}
            yield Measurement(node=node, value=shown[name], read=_of_same_array(name))


def _of_same_array(name: str) -> Reader:
    return lambda view: view.world.view(name)
