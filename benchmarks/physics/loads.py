"""Checks of bodies under loads against statics and momentum: stiff joints, forces, weight, commanded motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.physics.checks import Options, Quantity, at_most, check, equal
from benchmarks.physics.probe import EMPTY, GRAVITY, JOINTS, Probe
from piavatar_envs.avatar.body.muscles import LOCKED_JOINTS, make_muscles
from piavatar_envs.avatar.body.skeleton import BEYOND, JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.torque_control.joint_tissue import RETARDATION_TIME

LIFT_SPEED = 0.05  # of a box that rises against a limb [m/s]
SETTLING = 2.0  # time for a load to be carried [s]
SAMPLES = 500  # of a body's response to an impulse
FINE_STEP = 1.0 / 240.0  # control step where peaks are short [s]


@dataclass(frozen=True)
class Lift:
    """A smooth box that moves against a limb and stops.

    Attributes:
        bone: the bone that it meets.
        joint: whose stiffness is measured.
        center, half: place and half extents of the box [m].
        direction: in which it moves.
        way: how far [m].
    """

    bone: str
    joint: str
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    direction: tuple[float, float, float]
    way: float


LIFTS = {
    "ankle": Lift("left_ankle", "left_ankle", (0.17, -0.16, -0.083), (0.085, 0.05, 0.085), (0.0, 0.0, 1.0), 0.04),
    "wrist": Lift("left_wrist", "left_wrist", (0.47, -0.22, 0.93), (0.06, 0.06, 0.08), (0.0, 0.0, 1.0), 0.06),
    "neck": Lift("head", "neck", (0.0, -0.35, 1.56), (0.1, 0.1, 0.08), (0.0, 1.0, 0.0), 0.16),
}


def stiffness(options: Options, control: str, lift: Lift) -> Iterator[Quantity]:
    """Bend a joint by a box; compare moment over angle with the table's spring, and under pd the tissue beside it.

    Where joints resist under pose control, the root's rigid field carries its share of what is beyond the joint.
    """
    velocity = [LIFT_SPEED * part for part in lift.direction]
    box = {"name": "box", "kind": "box", "size": list(lift.half), "position": list(lift.center)}
    scene = {"ground": False, "colliders": [box | {"velocity": velocity, "friction": 0.0}]}
    probe = Probe.under(options, control, gravity=0.0, scene=scene)
    probe.run(lift.way / LIFT_SPEED)
    moving = probe.simulation.model.boundaries.velocity
    moving.zero_()
    probe.run(SETTLING)
    force, moment = (probe.sensor(f"boundary_{name}")[0] / probe.dt for name in ("impulse", "moment"))
    about = moment - np.cross(probe.pose[1][joint_index(lift.joint)], force)
    if control == JOINTS:
        about = about + moment_about(probe, lift.joint, root_forces(probe))
    angle = float(np.linalg.norm(probe.errors[joint_index(lift.joint)]))
    wanted = probe.spring(lift.joint)
    if control == "pd":
        wanted = float(np.linalg.norm(joint_moment(probe, lift.joint))) / max(angle, 1e-6)
    measured = float(np.linalg.norm(about)) / max(angle, 1e-6)
    yield equal(f"stiffness of the {lift.joint.removeprefix('left_')}", measured, wanted, 0.1 * wanted, "N m/rad")


def key_of(control: str) -> str:
    """Return the end of the names of checks of a control."""
    return control.replace(", ", "_")


def _register_lifts() -> None:
    for control in ("pose", JOINTS, "pd"):
        for name, lift in LIFTS.items():
            title = f"box rises against a limb, {name} ({control})"
            check(f"stiffness_{name}_{key_of(control)}", title)(partial(stiffness, control=control, lift=lift))


_register_lifts()


def moment_about(probe: Probe, joint: str, force: np.ndarray) -> np.ndarray:
    """Return the moment [N m] about a joint of forces on the particles beyond it, shape ``(P, 3)`` [N]."""
    share = probe.shares[:, BEYOND[joint_index(joint)]].sum(1, keepdims=True)
    return np.cross(probe.x[probe.body] - probe.pose[1][joint_index(joint)], share * force).sum(0)


def root_forces(probe: Probe) -> np.ndarray:
    """Return the root's force on every particle in the last control step [N], ``(P, 3)``: a rigid acceleration."""
    state, body = probe.simulation.avatar.state, probe.body
    mass, arm = probe.mass[body], probe.x[body] - probe.center(body)
    force, torque = (array.numpy()[0].astype(float) for array in (state.wrench_force, state.wrench_torque))
    inertia = (mass * (arm**2).sum(1)).sum() * np.eye(3) - (mass[:, None] * arm).T @ arm
    return mass[:, None] * (force / mass.sum() + np.cross(np.linalg.solve(inertia, torque), arm))


def joint_moment(probe: Probe, joint: str) -> np.ndarray:
    """Return the moment [N m] of a joint's spring and tissue on what is beyond it, in the world, for small errors."""
    index = joint_index(joint)
    goal = Rotation.from_quat(probe.simulation.avatar.state.goal_rotation.numpy()[0, index].astype(float))
    spring = -probe.spring(joint) * goal.apply(probe.errors[index])
    bend = probe.local * (np.arange(len(JOINT_NAMES)) > 0)[:, None]
    return probe.pose[0][PARENTS[index]] @ (spring + probe.tissue.torque(bend[None])[0, index])


@check("springs_weight", "held body hangs its limbs under gravity (pd)")
def springs_weight(options: Options) -> Iterator[Quantity]:
    """Compare the moment of each joint's spring and tissue with that of the weight beyond it."""
    probe = Probe.under(options, "pd", scene={"ground": False})
    probe.run(SETTLING)
    weight = probe.mass[probe.body, None] * [0.0, 0.0, -GRAVITY]
    joints = [name for name in JOINT_NAMES[1:] if not name.endswith("foot")]
    left = [np.linalg.norm(moment_about(probe, name, weight) + joint_moment(probe, name)) for name in joints]
    yield at_most("largest sum of spring's and weight's moment", max(left), 0.02, "N m", theory=0.0)


@check("force_foot", "20 N lift a foot of a held, weightless body (pd)")
def force_foot(options: Options) -> Iterator[Quantity]:
    """Compare the moments of the ankle's, the knee's and the hip's springs and tissue with the force times its arm."""
    probe, force = Probe.under(options, "pd", **EMPTY), np.array([0.0, 0.0, 20.0])
    foot = probe.particles_of("left_ankle", "left_foot")
    at = push(probe, "left_ankle", force, SETTLING, probe.mass[foot] @ probe.x[foot] / probe.mass[foot].sum())
    for name in ("left_ankle", "left_knee", "left_hip"):
        theory = -np.cross(at(probe) - probe.pose[1][joint_index(name)], force)[0]
        label = f"moment of the {name.removeprefix('left_')}'s spring about x"
        yield equal(label, joint_moment(probe, name)[0], theory, max(0.02, 0.02 * abs(theory)), "N m")


def force_hand(options: Options, control: str) -> Iterator[Quantity]:
    """Compare the error of each joint of the arm under tone 1 with the moment of the force over the table's spring."""
    probe, force = Probe.under(options, control, **EMPTY), np.array([0.0, 0.0, -20.0])
    at = push(probe, "left_wrist", force, SETTLING)
    for name in ("left_wrist", "left_elbow", "left_shoulder"):
        moment = np.linalg.norm(np.cross(at(probe) - probe.pose[1][joint_index(name)], force))
        wanted = np.degrees(moment / probe.spring(name))
        error = np.degrees(np.linalg.norm(probe.errors[joint_index(name)]))
        yield equal(f"angle of the {name.removeprefix('left_')}", error, wanted, 0.15 * wanted + 0.1, "deg")


for _control in ("pose", JOINTS):
    _name = "force_hand" if _control == "pose" else f"force_hand_{key_of(_control)}"
    check(_name, f"20 N pull a hand of a held, weightless body down ({_control})")(
        partial(force_hand, control=_control)
    )


def push(
    probe: Probe, bone: str, force: np.ndarray, seconds: float, point: np.ndarray | None = None
) -> Callable[[Probe], np.ndarray]:
    """Apply a force [N] to a bone for some time, and return the function from the probe to where it acts [m].

    Without a ``point`` it acts at the bone's centre of mass.
    """
    index, points, (rotation, position) = joint_index(bone), probe.points, probe.pose
    if point is None:
        weight = probe.shares[:, index] * probe.mass[probe.body]
        local = weight @ points.rest[0].astype(float) / weight.sum() - points.joints[0, index]
        point = position[index] + rotation[index] @ local
    local = rotation[index].T @ (point - position[index])
    probe.env.apply_force(bone, force, point=point, steps=round(seconds / probe.dt))
    probe.run(seconds)

    def place(now: Probe) -> np.ndarray:
        rotation, position = now.pose
        return position[index] + rotation[index] @ local

    return place


def rigid_response(probe: Probe, bone: str, impulse: np.ndarray, at: np.ndarray, seconds: float) -> np.ndarray:
    """Return how far the joints of an articulated body at rest turn in some time after an impulse [rad], ``(22, 3)``.

    Flesh moves as it is skinned to the bones; toes are part of the feet. Joints turn little, against their tissue:
    ``M a = -(D + tau K) v - K q`` with the mass matrix ``M`` and the stiffness ``K`` of the rest pose.
    """
    x, position, joints = probe.x[probe.body], probe.pose[1], range(len(JOINT_NAMES))
    size = 3 + 3 * len(JOINT_NAMES)

    def jacobian(place: np.ndarray, index: int) -> np.ndarray:
        found = np.zeros((3, size))
        found[:, :3] = np.eye(3)
        for b in joints:
            if BEYOND[b, index] and JOINT_NAMES[b] not in LOCKED_JOINTS:
                found[:, 3 + 3 * b : 6 + 3 * b] = np.cross(np.eye(3), place - position[b]).T
        return found

    inertia = np.zeros((size, size))
    for mass, place, shares in zip(probe.mass[probe.body], x, probe.shares, strict=True):
        found = sum(shares[index] * jacobian(place, index) for index in np.flatnonzero(shares))
        inertia += mass * found.T @ found
    moving = np.diagonal(inertia) > 1e-12
    bends, slight = np.eye(size - 3).reshape(-1, len(JOINT_NAMES), 3), 1.0e-4
    pulls = probe.tissue.pull(-slight * bends)[0] - probe.tissue.pull(slight * bends)[0]
    stiff = np.zeros((size, size))
    stiff[6:, 6:] = pulls.reshape(len(bends), -1)[3:, 3:] / (2.0 * slight)
    stiff = stiff[np.ix_(moving, moving)]
    own = np.r_[np.zeros(6), np.repeat(probe.size * make_muscles().tissue_damping[1:], 3)][moving]
    damping = np.diag(own) + float(RETARDATION_TIME) * stiff
    rate = np.linalg.solve(inertia[np.ix_(moving, moving)], (jacobian(at, joint_index(bone)).T @ impulse)[moving])
    dt, turned = seconds / SAMPLES, np.zeros(len(rate))
    implicit = np.linalg.inv(inertia[np.ix_(moving, moving)] + dt * damping + dt**2 * stiff)
    for _ in range(SAMPLES):
        rate = implicit @ (inertia[np.ix_(moving, moving)] @ rate - dt * stiff @ turned)
        turned += dt * rate
    found = np.zeros(size)
    found[moving] = turned
    return found[3:].reshape(-1, 3)


@check("impulse_foot", "upward impulse on a foot, floating, no torques (torque)")
def impulse_foot(options: Options) -> Iterator[Quantity]:
    """Kick a foot upwards in front of the ankle: the toes go up, as far as the tissue's damping lets them."""
    probe = Probe.under(options, "torque", held=False, control_dt=FINE_STEP, **EMPTY)
    foot = probe.particles_of("left_ankle", "left_foot")
    mass = probe.mass[foot].sum()
    impulse, rest, at = np.array([0.0, 0.0, 0.5 * mass]), probe.local, probe.mass[foot] @ probe.x[foot] / mass
    theory = np.degrees(rigid_response(probe, "left_ankle", impulse, at, 0.05)[joint_index("left_ankle"), 0])
    push(probe, "left_ankle", impulse / probe.dt, probe.dt, at)
    probe.run(0.05 - 0.5 * probe.dt)
    turned = np.degrees((probe.local - rest)[joint_index("left_ankle"), 0])
    yield equal("angle of the ankle about x after 50 ms", turned, theory, 0.1 * abs(theory), "deg")


def legs_pressed(options: Options, control: str) -> Iterator[Quantity]:
    """Press the legs together by 28 degrees each and open them again: after 4 s no joint is bent any more."""
    probe = Probe.under(options, control, scene={"ground": False, "self_contact": True})
    names, closed = probe.env.action_names, np.zeros((len(JOINT_NAMES), 3))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        closed[joint_index(f"{side}_hip"), 1] = sign * np.radians(28.0)
    for wanted, seconds in ((closed, 2.0), (np.zeros_like(closed), 5.5)):
        for _ in range(round(seconds / probe.dt)):
            state = probe.simulation.avatar.state
            now = Rotation.from_quat(state.command_rotation.numpy()[0].astype(float)).as_rotvec()
            action = np.zeros(len(names), np.float32)
            rates = np.clip((wanted - now) / (probe.env.config.control.joint_speed_limit * probe.dt), -1.0, 1.0)
            for index, name in enumerate(names):
                joint, _, axis = name.partition(".")
                if joint in JOINT_NAMES and axis in ("x", "y", "z"):
                    action[index] = rates[joint_index(joint), "xyz".index(axis)]
            probe.step(action)
    errors = np.degrees(np.linalg.norm(probe.errors, axis=1))[1:]
    worst = JOINT_NAMES[1 + int(errors.argmax())].replace("_", " ")
    yield replace(at_most("largest error of a joint 4 s later", errors.max(), 1.0, "deg", theory=0.0), note=worst)


for _control in ("pose", JOINTS):
    _name = "legs_pressed" if _control == "pose" else f"legs_pressed_{key_of(_control)}"
    check(_name, f"legs pressed together and opened, self-contact ({_control})")(
        partial(legs_pressed, control=_control)
    )


def kick(action: np.ndarray, step: int, _rng: np.random.Generator) -> None:
    """Raise one leg at full speed."""
    action[0] = -1.0 if 3 <= step < 9 else 0.0


def full_scale(action: np.ndarray, _step: int, rng: np.random.Generator) -> None:
    """Draw uniform actions."""
    action[:] = rng.uniform(-1.0, 1.0, action.shape)


def jerk_root(action: np.ndarray, step: int, _rng: np.random.Generator) -> None:
    """Push the root's velocity to its greatest for one step."""
    action[63] = 1.0 if step == 3 else 0.0


#: Task, settings, action and steps by name.
MOTIONS: dict[str, tuple[str, dict, Callable[[np.ndarray, int, np.random.Generator], None], int]] = {
    "kick": ("Reach", {}, kick, 10),
    "random": ("KickBall", {"bound_motion": True}, full_scale, 25),
    "root": ("TrackMotion", {"motion": "t_pose", "impulse": 0.0, "bound_motion": True}, jerk_root, 6),
    "pd": ("Stand", {"control": "pd", "root_assist": 0.0}, full_scale, 25),
    "kick_pose_joints": ("Reach", {"resistance": "joints"}, kick, 10),
    "random_pose_joints": ("KickBall", {"resistance": "joints", "bound_motion": True}, full_scale, 25),
    "free_pose_joints": ("Reach", {"resistance": "joints", "root": "free"}, full_scale, 25),
}


def momentum_balance(options: Options, motion: str) -> Iterator[Quantity]:
    """Compare each step's change of the avatar's momentum with gravity, contact and ``info["root_force"]``."""
    task, settings, act, steps = MOTIONS[motion]
    probe, rng = Probe.of(options, task, **settings), np.random.default_rng(0)
    weight = GRAVITY * float(probe.mass[probe.body].sum())
    unexplained, largest = 0.0, 0.0
    for step in range(steps):
        before = probe.momentum(probe.body)
        act(probe.action, step, rng)
        info = probe.step()
        contact = probe.sensor("boundary_impulse")[0]
        subjects = len(probe.sensor("boundary_impulse"))
        if subjects > 1:
            contact = contact + probe.sensor("pair_impulse").reshape(subjects, subjects, 3)[0, 1:].sum(0)
        root = np.asarray(info["root_force"], float)
        known = contact + probe.dt * (root - [0.0, 0.0, weight])
        unexplained = max(unexplained, float(np.linalg.norm(probe.momentum(probe.body) - before - known)))
        largest = max(largest, float(np.linalg.norm(root)) / weight)
    yield at_most("momentum of unknown origin in a step, at most", unexplained, 1e-3, "N s", theory=0.0)
    if motion != "pd":
        yield at_most("root force over weight, at most", largest, 2.0)


MOTION_TITLES = {
    "kick": "one leg kicks at full speed (pose)",
    "random": "random full-scale actions in KickBall (pose)",
    "root": "root commanded from 0 to full speed in a step (pose)",
    "pd": "random full-scale targets (pd, unassisted)",
    "kick_pose_joints": f"one leg kicks at full speed ({JOINTS})",
    "random_pose_joints": f"random full-scale actions in KickBall ({JOINTS})",
    "free_pose_joints": f"random full-scale actions, nothing holds the root ({JOINTS})",
}
for _name, _title in MOTION_TITLES.items():
    check(f"root_force_{_name}", _title)(partial(momentum_balance, motion=_name))


@check("sag_pose", "soft flesh on a standing body, its weight (pose, root=weight)")
def sag_pose(options: Options) -> Iterator[Quantity]:
    """Let soft flesh hang on bones: it sags by ``rho g L^2 / 2 E`` over a length ``L``, in inverse proportion to E."""
    sags = []
    for modulus in (1.0e4, 2.0e4):
        probe = Probe.under(options, "pose", young_modulus=modulus, scene={"ground": False}, root="weight")
        probe.run(SETTLING)
        sags.append(float(probe.displacement().mean()))
    yield equal("mean sag at 1e4 Pa over that at 2e4 Pa", sags[0] / sags[1], 2.0, 0.1)
