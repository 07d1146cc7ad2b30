"""Things that would begin inside of others are refused with the way out; contact is allowed."""

from __future__ import annotations

import re

import numpy as np
import pytest

from piavatar_envs.config import ColliderConfig, ConfigError, PropConfig, load_config, replace
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task
from piavatar_envs.tasks.games.sumo import SumoTask

REACH = "PIAvatar/Reach-v0"
BALL = {"name": "ball", "mass": 0.5, "size": [0.15]}
CRATE = {"name": "crate", "kind": "box", "size": [0.3, 0.3, 0.3]}
FLOOR = {"name": "floor", "kind": "plane"}


def build(device, task=REACH, fidelity="tiny", **scene) -> BatchEnv:
    cls = load_task(task)
    return BatchEnv(cls(load_config(cls.Config, None, {"fidelity": fidelity, "scene": scene})), 1, device)


INSIDE = {
    "ball in the belly": {"props": [BALL | {"position": [0.0, 0.0, 1.0]}]},
    "beside the origin": {
        "props": [BALL | {"position": [0.9, 0.3, 1.0]}],
        "avatars": [{"position": [0.9, 0.3], "yaw": 1.0}],
    },
    "ball in the crate": {
        "colliders": [CRATE | {"position": [0.0, -1.0, 1.0]}],
        "props": [BALL | {"position": [0.1, -1.0, 1.0]}],
    },
    "ball in the floor": {"props": [BALL | {"position": [0.0, -1.0, -0.1]}]},
    "feet in a step": {"colliders": [FLOOR | {"position": [0.0, 0.0, 0.3]}]},
    "box that stands in the legs": {
        "props": [{"name": "box", "shape": "box", "size": [0.3, 0.3, 0.3], "position": [0.0, -0.15, 0.3]}]
    },
}


@pytest.mark.parametrize("scene", INSIDE.values(), ids=INSIDE)
def test_what_is_inside_is_refused_and_the_remedy_helps(device, scene):
    with pytest.raises(ConfigError, match=r"would begin .*inside .*; move it by ") as refused:
        build(device, **scene)
    move, *way = map(float, re.search(r"move it by (\S+) m along \[(.*), (.*), (.*)\]", str(refused.value)).groups())
    kind = "props" if str(refused.value).startswith("prop") else "colliders"
    moved = [scene[kind][0] | {"position": list(np.array(scene[kind][0]["position"]) + move * np.array(way))}]
    build(device, **scene | {kind: moved})


@pytest.mark.parametrize(
    "scene",
    [
        {"props": [BALL | {"position": [0.0, -0.26, 1.0]}]},
        {"props": [BALL | {"position": [0.0, -1.0, -0.1]}], "ground": False},
        {"colliders": [CRATE | {"position": [0.0, -1.0, 0.3]}, FLOOR], "props": [BALL | {"position": [0, -1.0, 0.73]}]},
        {"avatars": [{"position": [0.0, 0.2]}], "props": [BALL | {"position": [0.0, -0.12, 1.0]}]},
    ],
)
def test_contact_is_allowed(device, scene):
    build(device, **scene)


def test_a_ball_may_lie_in_a_hand(device):
    batch = build(device)
    batch.reset(seeds=[0])
    hand = batch.simulation.avatar.tracked.position.numpy()[0, 20]
    build(device, props=[BALL | {"size": [0.06], "position": hand.tolist()}])


#: At ``coarse`` a grid spacing is 5.2 cm; each with what differs where it is allowed.
BEHIND = {"name": "wall", "kind": "box", "size": [0.3, 0.1, 0.3], "position": [0.0, 0.2, 1.0]}
ROD = {"name": "rod", "shape": "capsule", "size": [0.05, 0.4], "mass": 2.0, "position": [0.0, -1.0, 1.0]}
POST = {"name": "post", "kind": "box", "size": [0.1, 0.1, 0.1], "position": [0.0, -1.35, 1.0]}
POLE = {"name": "pole", "kind": "capsule", "size": [0.045, 0.6], "rotation": [0.7071, 0.0, 0.7071, 0.0]}
COARSE = {
    "a turned avatar": ({"colliders": [BEHIND], "avatars": [{"yaw": 1.57}]}, {"avatars": [{"yaw": 0.0}]}),
    "a turned rod": (
        {"props": [ROD | {"rotation": [0.7071, 0.7071, 0.0, 0.0]}], "colliders": [POST]},
        {"props": [ROD]},
    ),
    "a ball that is not only in contact": (
        {"props": [BALL | {"position": [0.0, -1.2, 1.18]}], "colliders": [POST | {"position": [0.0, -1.2, 1.0]}]},
        {"props": [BALL | {"position": [0.0, -1.2, 1.21]}]},
    ),
    "the end of a pole": (
        {"colliders": [POLE | {"position": [0.5, -0.03, 1.1]}]},
        {"colliders": [POLE | {"position": [0.8, -0.03, 1.1]}]},
    ),
}


@pytest.mark.parametrize(("scene", "instead"), COARSE.values(), ids=COARSE)
def test_how_things_lie_is_seen(device, scene, instead):
    with pytest.raises(ConfigError, match=r"would begin .*inside .*; move it by "):
        build(device, fidelity="coarse", **scene)
    build(device, fidelity="coarse", **scene | instead)


def test_matter_behind_a_thin_plate_is_seen(device):
    # A third of the ball begins beyond the plate, none of it deep inside.
    plate = {"name": "plate", "kind": "box", "size": [0.4, 0.01, 0.4], "position": [0.0, -1.0, 1.0]}
    scene = {"colliders": [plate], "props": [BALL | {"size": [0.2], "position": [0.0, -1.06, 1.0]}]}
    with pytest.raises(ConfigError, match=r"inside collider 'plate'; .* move it by ") as refused:
        build(device, fidelity="coarse", **scene)
    move, *way = map(float, re.search(r"by (\S+) m along \[(.*), (.*), (.*)\]", str(refused.value)).groups())
    scene["props"][0]["position"] = list(np.array([0.0, -1.06, 1.0]) + move * np.array(way))
    build(device, fidelity="coarse", **scene)


def test_meshes_are_looked_at(device, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "cube.obj"
    trimesh.creation.box((2.0, 2.0, 2.0)).export(path)
    cube = {"name": "cube", "shape": "mesh", "file": str(path), "size": [0.12], "mass": 2.0}
    with pytest.raises(ConfigError, match=r"prop 'cube' would begin .* inside agent_0; .* move it by"):
        build(device, fidelity="coarse", props=[cube | {"position": [0.0, 0.0, 1.1]}])
    build(device, fidelity="coarse", props=[cube | {"position": [0.0, -0.4, 1.1]}])


def test_all_avatars_are_looked_at(device):
    x, y = SumoTask(load_config(SumoTask.Config)).scene.avatars[-1].position
    with pytest.raises(ConfigError, match=r"prop 'ball' would begin .* inside agent_1"):
        build(device, SumoTask, props=[BALL | {"position": [x, y, 1.0]}])


class Ram(load_task(REACH)):
    """A task whose own prop and collider would overlap the body and each other, if they began where they are."""

    def build_scene(self):
        ball = PropConfig(name="own", size=(0.1,), position=(0.0, 0.0, 1.0))
        ram = ColliderConfig(name="ram", kind="sphere", size=(0.25,), position=(0.0, 0.1, 1.0))
        return replace(super().build_scene(), props=[ball], colliders=[ram])


def test_a_task_places_what_it_adds_itself(device):
    build(device, Ram)
