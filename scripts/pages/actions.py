"""Section of a page on actions."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.observations import JOINT_TERMS
from scripts.pages.entries import Facts
from scripts.pages.markdown import code, number, page, table


def actions_section(facts: Facts) -> str:
    """Describe the components of an action, by default and under the other kinds of control."""
    spec, dt, posed = facts.actions, facts.config.physics.control_dt, facts.config.control.mode == "pose"
    lower, upper = np.degrees(facts.task.limits())
    joints, root = [], []
    for n, joint in enumerate(spec.joints):
        b = joint_index(joint)
        ranges = [f"{number(lower[b, axis])} to {number(upper[b, axis])}" for axis in range(3)]
        step = (f"{number(spec.joint_speed * dt)} rad",) if posed else ()
        joints.append((code(f"{3 * n}:{3 * n + 3}"), code(f"{joint}.x .y .z"), *step, *ranges))
    for n, (name, limit, text) in enumerate(_root_components(spec, dt) if spec.root else (), 3 * len(joints)):
        root.append((code(f"{n}:{n + 1}"), code(name), limit, text))
    meaning = _of_poses() if posed else _of_targets(facts)
    step = ("at 1, a step",) if posed else ()
    return page(
        [
            "## Actions",
            f"Components are clipped to [-1, 1]. Each joint has three: {meaning}",
            table(("slice", "components", *step, "range of x [deg]", "of y [deg]", "of z [deg]"), joints),
            "The commanded root moves as well:" if root else "",
            table(("slice", "component", "at 1, a step", "direction"), root) if root else "",
            _under_torques(facts) if posed else _under_others(facts),
        ]
    )


def _of_poses() -> str:
    """Describe a joint's components under pose control."""
    return (
        "the rotation vector by which its local rotation is turned in the step, in the bone's own axes. In the rest "
        "pose these are the world's: the avatar faces -y, its left is +x. `joint_speed_limit` scales them, and the "
        "joint's whole rotation vector is kept within its range."
    )


def _of_targets(facts: Facts) -> str:
    """Describe a joint's components under torque control, by default joint targets."""
    return (
        "the rotation vector that its spring pulls to, relative to the parent bone. In the rest pose the axes are the "
        f"world's: the avatar faces -y, its left is +x. 0 is {_middle(facts)}, 1 and -1 are the ends of the range "
        "below, and in between the target is proportional to the component. The torque of a spring is limited to the "
        "greatest of its joint; only the ground and `root_assist` hold the body."
    )


def _middle(facts: Facts) -> str:
    """Name the pose that targets are counted from."""
    return "the task's reference pose" if facts.task.targets_about_reference else "the rest pose"


def _under_others(facts: Facts) -> str:
    """Describe the other kinds of control, where joint targets are the default."""
    size = facts.task.action_spec().size
    return (
        'With `control="torque"` a component is a share of the greatest torque of the joint about that axis. With '
        f'`"pose"` there are {size} components, including the toes and root actions of the task: they turn the '
        "commanded pose, and the root wrench holds the body."
    )


def _under_torques(facts: Facts) -> str:
    """Describe actions under torque control."""
    size = facts.task.action_spec().under("pd").size
    about = _middle(facts)
    terms = ", ".join(f"{code(term.name)} ({term.size}, {term.unit})" for term in JOINT_TERMS)
    return (
        f'With `control="pd"` or `"torque"` there are {size} components: neither the root nor the toes act. Under '
        f'`"pd"` a component is a target angle: 0 is {about}, 1 and -1 are the ends of the ranges above. Under '
        '`"torque"` it is a share of the greatest torque of the joint about that axis. Only the ground '
        f"and `root_assist` hold the body then, there is no wrench to release, and {terms} are observed as well."
    )


def _root_components(spec: ActionSpec, dt: float) -> list[tuple[str, str, str]]:
    way, turn = f"{number(spec.root_speed * dt)} m", f"{number(spec.root_turn_speed * dt)} rad"
    directions = ("to the avatar's left", "to its back: forward is negative", "turn about the vertical, to the left")
    return list(zip(spec.names()[-3:], (way, way, turn), directions, strict=True))
