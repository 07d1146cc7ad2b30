"""What would begin inside of something else is refused with the way out, and contact is not."""

from __future__ import annotations

import re

import numpy as np
import pytest

from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.config import ConfigError, load_config
from piavatar_envs.tasks import load_task

REACH = "PIAvatar/Reach-v0"
BALL = {"name": "ball", "mass": 0.5, "size": [0.15]}
CRATE = {"name": "crate", "kind": "box", "size": [0.3, 0.3, 0.3]}
FLOOR = {"name": "floor", "kind": "plane"}


def build(device, env_id=REACH, **scene) -> BatchEnv:
    task = load_task(env_id)
    return BatchEnv(task(load_config(task.Config, None, {"fidelity": "tiny", "scene": scene})), 1, device)


INSIDE = {
    "ball in the belly": {"props": [BALL | {"position": [0.0, 0.0, 1.0]}]},
    "ball in the head": {"props": [BALL | {"position": [0.0, 0.0, 1.6]}]},
    "beside the origin": {
        "props": [BALL | {"position": [0.9, 0.3, 1.0]}],
        "avatars": [{"position": [0.9, 0.3], "yaw": 1.0}],
    },
    "crate in the body": {"colliders": [CRATE | {"position": [0.0, 0.2, 1.0]}]},
    "ball in the crate": {
        "colliders": [CRATE | {"position": [0.0, -1.0, 1.0]}],
        "props": [BALL | {"position": [0.1, -1.0, 1.0]}],
    },
    "ball in the floor": {"props": [BALL | {"position": [0.0, -1.0, -0.1]}]},
    "feet in a step": {"colliders": [FLOOR | {"position": [0.0, 0.0, 0.3]}]},
    "slope": {"colliders": [FLOOR | {"position": [0.0, 1.0, 0.0], "rotation": [0.92, -0.38, 0.0, 0.0]}]},
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
        {"props": [BALL | {"position": [0.0, -1.0, 0.14]}]},
        {"props": [BALL | {"position": [0.0, -0.26, 1.0]}]},
        {"props": [BALL | {"position": [0.0, -1.0, -0.1]}], "ground": False},
        {"colliders": [CRATE | {"position": [0.0, -0.45, 1.0]}, FLOOR]},
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


def test_who_does_not_stand_is_not_taken_to_stand(device):
    build(device, "PIAvatar/GetUp-v0", props=[BALL | {"position": [0.0, 0.0, 1.3]}])
