"""An agent for bodies that stand by joint torques (``control="torque"``), such as PIAvatar/Stand-v0: PID and balance.

It uses the observation that every agent gets, and masses, lengths and strengths of the body.
Four parts add up to the torques of a step::

    balance      where the centre of pressure has to be (:mod:`agents.pid.balance`): the force of the ground on both
    feet feet         what the joints of the legs give for it, J^T f, from the soles up
    weight       what all joints give to carry what hangs on them
    PID          what they give besides to hold a pose, or to follow a clip (:class:`~agents.pid.controller.PosePID`),
    with an
                 integral above the legs; in the legs gains may go with the load on each (:mod:`agents.pid.gains`)

The joints of a body move each other, and torques are held for a control step: gains that know of one joint's inertia
only throw the short, light bones of the spine to and fro from step to step, the muscles saturate and the body folds.
The PID therefore looks ahead with the mass matrix of the whole body (:func:`~agents.pid.bones.answered`).

:func:`make_pid_agent` makes one for a task; it is called with observations ``(n, observation_size)``.

The numbers of the PID agent (:mod:`agents.pid.agent`): what its designer may choose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from agents.pid.balance import FRONTAL, GRAVITY, Balance, Effort, Stance
from agents.pid.bones import NUM_DOF, Bones, Posture, answered, force_moments, in_bones
from agents.pid.controller import PID, PosePID, difference, follow
from agents.pid.gains import LoadSchedule, gains_by_strength
from agents.pid.tissue import Tissue
from piavatar_envs.avatar.body.muscles import REFERENCE_HEIGHT, REFERENCE_MASS, make_muscles
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_ACTUATED, NUM_JOINTS, joint_index
from piavatar_envs.avatar.torque_control.joint_tissue import RETARDATION_TIME
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.tasks import load_task

SIDES = ("left", "right")
#: Joints of each leg, as places among all joints but the root.
LEGS = {side: [joint_index(f"{side}_{joint}") - 1 for joint in ("hip", "knee", "ankle", "foot")] for side in SIDES}
HIPS, ANKLES = ([joint_index(f"{side}_{joint}") for side in SIDES] for joint in ("hip", "ankle"))
#: Time over which the load of the feet is averaged [s].
LOAD_TIME = 0.02
#: Share of the weight on the feet from which on legs push with all of it.
BEARING = 0.5


#: Joints above the legs: chains whose ends are free, so that their integrals can undo their errors.
ABOVE_LEGS = tuple(name for name in JOINT_NAMES[1:] if name.partition("_")[2] not in ("hip", "knee", "ankle", "foot"))


@dataclass(frozen=True)
class Design:
    """Numbers of the controller. Lengths are of a body at grid spacings of 5 cm, ``fidelity="coarse"``.

    Attributes:
        stiffness: of the joints by their strength [1/rad], see :func:`~agents.pid.gains.gains_by_strength`.
        damping_time: ``kd / kp`` [s].
        integral_time: ``kp / ki`` [s] of the joints that have an integral; infinite for none.
        integrated: names of these joints. The integral takes away the error that is left because tissue gives way and
            holds back: above the legs, in the second half of 8 episodes of Stand, 13 degrees in neck and arms become 3
            and 10 in the spine become 5, and no episode ends. Two legs on the ground are a closed chain: errors that
            friction does not let them undo wind up the integrals of both, against each other, until a foot slips (at
            2 s after some 15 s). Theirs are for bodies whose pelvis is held.
        unloaded: factor on the gains of a leg that bears nothing [-], see :class:`~agents.pid.gains.LoadSchedule`; one
            that bears half of the weight has 1. With 1, the default, the schedule is off, because softer legs gained
            nothing.
        followed: names of the joints that follow a clip of the task; the others hold the rest pose. The balance
            controller ignores the clip: where feet leave the ground the body falls later if only ``ABOVE_LEGS``
            follow; where they stay on it, all joints follow better.
        support: from the ankles to the hindmost and to the foremost place of the centre of pressure that ankles can
            hold [m]. A foot that is pressed further back rolls over its heel, up to the stop of its ankle; the rest
            pose has the centre of mass just 12 mm ahead of the ankles.
        foot_width: within which ankles can hold it sideways [m].
        gain: of the balance, see :class:`~agents.pid.balance.Balance`.
        hip_threshold, hip_gain: of the hip strategy, see :class:`~agents.pid.balance.Balance`.
        hip_share: share of the strength of both hips that it has [-]. A body that walks is beyond the threshold all
            the time: after DeepMimic's walk it falls later without (12 episodes: after 0.6 instead of 0.4 s).
    """

    stiffness: float = 1.75
    damping_time: float = 0.06
    integral_time: float = 2.0
    integrated: tuple[str, ...] = ABOVE_LEGS
    unloaded: float = 1.0
    followed: tuple[str, ...] = JOINT_NAMES[1:]
    support: tuple[float, float] = (0.010, 0.112)
    foot_width: float = 0.04
    gain: float = 0.72
    hip_threshold: float = 0.77
    hip_gain: float = 6.0
    hip_share: float = 0.6

    def check(self) -> None:
        """Refuse a design with numbers out of range or unknown joints.

        Raises:
            ConfigError: a name that is not a joint's, or a number out of range.
        """
        for field in fields(self):
            name, value = field.name, getattr(self, field.name)
            if name in ("integrated", "followed"):
                unknown = [joint for joint in value if joint not in JOINT_NAMES[1:]]
                if unknown:
                    raise ConfigError(
                        f"{name}: {unknown[0]!r} is not a joint; use some of {', '.join(JOINT_NAMES[1:])}"
                    )
            elif name == "integral_time":
                if not value > 0.0:
                    raise ConfigError(f"{name}={value} must be > 0 [s], or inf for no integral")
            elif not all(0.0 <= number < np.inf for number in np.atleast_1d(value)):
                raise ConfigError(f"{name}={value} must be >= 0, and finite")


#: What the numbers are by default.
DEFAULT = Design()


class PIDAgent:
    """Agent that balances in a pose, or while it follows a clip.

    Attributes:
        bones: the body.
        balance: the strategy of its ankles and hips.
        effort: of the balance in the last step.
    """

    def __init__(
        self,
        env: BatchEnv,
        design: Design = DEFAULT,
        poses: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        """Design the controller for the body of an environment.

        Args:
            env: a batch of the task, of any size; its body, layout and time step are read, not its state.
            design: numbers of the controller.
            poses: what to follow, from times since the episode began [s] ``(n,)`` to rotation vectors of all joints but
                the root ``(n, 21, 3)``, such as :func:`~agents.pid.controller.motion_poses` gives or
                :func:`rest_poses`; None for the clip that the observation shows, as that of TrackMotion does, and
                where it shows none the rest pose.

        Raises:
            ConfigError: a design that is not a controller.
            ValueError: joints that are not moved by torques.
        """
        design.check()
        if env.control != "torque":
            raise ValueError(f'control={env.control!r}; the PID agent gives torques: make it with control="torque"')
        self.design, self.layout, self.dt = design, env.layout, env.config.physics.control_dt
        self.friction = env.config.physics.friction
        points = env.simulation.flesh[0].points
        self.bones, self.acting = Bones.of(points), [joint_index(name) for name in env.action_spec.joints]
        size = self.bones.mass.sum() * np.ptp(points.rest[0][:, 2]) / (REFERENCE_MASS * REFERENCE_HEIGHT)
        muscles = make_muscles(strength=env.config.control.strength)
        self.lower, self.upper = size * muscles.lower, size * muscles.upper
        self.tissue = Tissue(size, env.simulation.flesh[0].torque_control().tissue.flesh)
        self._tissue_damping = size * muscles.tissue_damping
        self.balance = self._balance()
        self.poses = poses
        self.begin(0)

    def _balance(self) -> Balance:
        """Build the balance strategy of a body that stands in its rest pose."""
        bones, design = self.bones, self.design
        height = float(bones.mean(bones.centres[None])[0, 2] - bones.joints[ANKLES, 2].mean())
        beside = float(np.ptp(bones.joints[ANKLES, 0]) + design.foot_width) / 2.0
        back, front = design.support
        stance = Stance(float(bones.mass.sum()), height, -back, front, beside, design.foot_width)
        limit = 2.0 * design.hip_share * np.minimum(self.upper, -self.lower)[HIPS[0], :2]
        return Balance(
            stance, design.gain, hip_threshold=design.hip_threshold, hip_gain=design.hip_gain, hip_limit=tuple(limit)
        )

    def begin(self, n: int) -> None:
        """Begin ``n`` episodes and clear the state of earlier ones."""
        design, limit = self.design, np.maximum(-self.lower, self.upper)[1:]
        stiff = np.ones((NUM_JOINTS, 3))
        stiff[ANKLES, 0] = 0.0  # ankles press the ground; the PID keeps feet from turning over
        times = np.where(np.isin(JOINT_NAMES[1:], design.integrated), design.integral_time, np.inf)[:, None]
        gains = gains_by_strength(np.maximum(limit, 1e-6), design.stiffness, design.damping_time, times)
        self.pid = PosePID(PID(gains, self.dt, (n, NUM_ACTUATED, 3)))
        self.effort: Effort | None = None
        self._schedule = LoadSchedule(NUM_ACTUATED, LEGS, design.unloaded)
        self._stiff, self._time, self._load = stiff[1:], np.zeros(n), np.zeros(n)
        self._leg_loads = np.zeros((n, len(SIDES)))  # shares of the weight
        self._followed = np.isin(JOINT_NAMES[1:], design.followed)[:, None]
        self._clip: np.ndarray | None = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return actions ``(n, action_size)`` for observations ``(n, observation_size)``."""
        n = len(observation)
        if n != len(self._time):
            self.begin(n)
        observation = np.asarray(observation, float)
        seen, now = self.layout.split(observation), self.posture(observation)
        local = _matrices(seen["joint_rotations"].reshape(n, NUM_ACTUATED, 6))
        rate = np.einsum("nbij,nbi->nbj", local, seen["joint_velocities"].reshape(n, NUM_ACTUATED, 3))
        moments = self.bones.weight_moments(now, GRAVITY) + self._ground_moments(seen, now)
        vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(n, NUM_ACTUATED, 3)
        bend = np.concatenate([np.zeros((n, 1, 3)), vectors], axis=1)
        matrix, resisted = self._answer(now, bend), self.tissue.torque(bend)[:, 1:]
        target, target_rate = self._target(seen, vectors)
        torque = self.pid.step(
            vectors,
            target,
            rate,
            target_rate,
            feedforward=-in_bones(now, moments)[:, 1:] - np.einsum("nbij,nbi->nbj", local, resisted),
            factor=self._stiff * self._schedule(self._leg_loads),
            ahead=lambda still, added: answered(matrix, still, added),
            given=lambda asked: self.given(local, asked),
        )
        self._time += self.dt
        return self.actions(np.einsum("nbij,nbj->nbi", local, torque))

    def given(self, local: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """Return what muscles give of torques ``(n, 21, 3)`` on bones that ``local`` turns from their parents [N m].

        Their limits are along the parents' axes, and seldom the same in both directions: a neck has nearly twice as
        much one way as the other.
        """
        along = np.clip(np.einsum("nbij,nbj->nbi", local, asked), self.lower[1:], self.upper[1:])
        return np.einsum("nbij,nbi->nbj", local, along)

    def actions(self, torque: np.ndarray) -> np.ndarray:
        """Return ``torque`` ``(n, 21, 3)``, in the parents' axes [N m], as shares of the greatest torques."""
        torque, lower, upper = torque[:, [j - 1 for j in self.acting]], self.lower[self.acting], self.upper[self.acting]
        return np.clip(np.where(torque > 0.0, torque / upper, -torque / lower), -1.0, 1.0).reshape(len(torque), -1)

    def posture(self, observation: np.ndarray) -> Posture:
        """Reconstruct the bones, from the pelvis joint, from observations ``(n, observation_size)``."""
        n, seen = len(observation), self.layout.split(observation)
        root, local = (_matrices(seen[name].reshape(n, -1, 6)) for name in ("root_orientation", "joint_rotations"))
        places = np.concatenate([np.zeros((n, 1, 3)), seen["bone_positions"].reshape(n, NUM_ACTUATED, 3)], axis=1)
        return self.bones.posture(np.concatenate([root, local], axis=1), _world(root[:, 0], places))

    def _target(self, seen: Mapping[str, np.ndarray], vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the target pose [rad] and its rate [rad/s], ``(n, 21, 3)`` each.

        Of ``poses``; without them of the clip that the task shows one step ahead, else the rest pose.
        """
        if self.poses is not None or "reference_turns" not in seen:
            return follow(self.poses or rest_poses, self._time, self.dt)
        turns = Rotation.from_rotvec(seen["reference_turns"].reshape(-1, 3))
        coming = (Rotation.from_rotvec(vectors.reshape(-1, 3)) * turns).as_rotvec().reshape(vectors.shape)
        # the reference of a step ago is the clip now; an episode begins in the clip's own pose
        coming = np.where(self._followed, coming, 0.0)
        now = np.where(self._followed, vectors, 0.0) if self._clip is None else self._clip
        self._clip = coming
        return now, difference(now, coming) / self.dt

    def _answer(self, now: Posture, bend: np.ndarray) -> np.ndarray:
        """Return the mass matrix, with the inertia that tissue adds to it: what it resists within a step."""
        matrix = self.bones.mass_matrix(now)
        stiffness = self.tissue.pull(bend)[1].max(axis=-1)
        resisting = self.dt * (self._tissue_damping + (RETARDATION_TIME + self.dt) * stiffness)
        joints = np.arange(NUM_DOF - 3 * NUM_ACTUATED, NUM_DOF)
        matrix[:, joints, joints] += np.repeat(resisting[:, 1:], 3, axis=1)
        return matrix

    def _ground_moments(self, seen: Mapping[str, np.ndarray], now: Posture) -> np.ndarray:
        """Return moments of the wanted ground force on the feet about all joints [N m], ``(n, 22, 3)``."""
        root, stance = now.rotation[:, 0], self.balance.stance
        feet = now.joints[:, ANKLES]
        left = (feet[:, 0] - feet[:, 1]) * [1.0, 1.0, 0.0]
        apart = np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-6)
        left = left / apart
        ahead = np.stack([left[:, 1], -left[:, 0], np.zeros(len(left))], axis=1)
        offset = self.bones.mean(now.centres) - feet.mean(1)
        velocity = self.bones.mean(_world(root, seen["bone_velocities"].reshape(-1, NUM_JOINTS, 3)))
        planes = np.stack([ahead, left], axis=1)
        effort = self.balance.step(*(np.einsum("nai,ni->na", planes, part) for part in (offset, velocity)))
        self.effort = effort
        weight = stance.mass * GRAVITY
        height = np.maximum(offset[:, 2:], 0.5 * stance.height)
        pressed = np.einsum("na,nai->ni", effort.pressure, planes)
        push = weight * (offset - pressed)
        push = push / height * self._bearing(seen, root, offset[:, 2])[:, None]
        turn = -np.einsum("na,nai->ni", effort.hip, planes) / height
        # the legs share the load as levers do; what they cannot, a foot does by its width
        half = apart[:, 0] / 2.0
        share = np.clip(0.5 + effort.pressure[:, FRONTAL] / (2.0 * half), 0.0, 1.0)
        edge = stance.foot_width / 2.0
        within = np.clip(effort.pressure[:, FRONTAL] - (2.0 * share - 1.0) * half, -edge, edge)
        place = effort.pressure[:, :1] * ahead + within[:, None] * left
        self._leg_loads = self._load[:, None] * np.stack([share, 1.0 - share], axis=1)
        return sum(
            force_moments(now, ankle, feet[:, side] + place, (push + turn) * part[:, None])
            for side, (ankle, part) in enumerate(zip(ANKLES, (share, 1.0 - share), strict=True))
        )

    def _bearing(self, seen: Mapping[str, np.ndarray], root: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return the share of the weight that the legs may push with, ``(n,)``: small while the feet bear little."""
        stance = self.balance.stance
        force = _world(root, seen["ground_impulse"][:, None])[:, 0, 2] / (self.dt * stance.mass * GRAVITY)
        self._load += (1.0 - np.exp(-self.dt / LOAD_TIME)) * (np.clip(force, 0.0, 1.0) - self._load)
        return np.clip(self._load / BEARING, 0.0, 1.0) * (height > 0.5 * stance.height)


def make_pid_agent(
    task: str = "Stand-v0",
    settings: Mapping[str, Any] | None = None,
    design: Design = DEFAULT,
    poses: Callable[[np.ndarray], np.ndarray] | None = None,
) -> PIDAgent:
    """Build an agent for a task.

    Args:
        task: id, with or without the namespace.
        settings: those that the environments are made with, ``control="torque"`` among them.
        design: numbers of the controller.
        poses: what to follow, see :class:`PIDAgent`.

    Raises:
        ConfigError: a setting that is unknown, of the wrong type or out of range, also of the design.
        ValueError: an unknown task, or joints that are not moved by torques.
    """
    kind = load_task(task)
    return PIDAgent(BatchEnv(kind(load_config(kind.Config, None, dict(settings or {})))), design, poses)


def rest_poses(times: np.ndarray) -> np.ndarray:
    """Return a clip that stands still in the rest pose."""
    return np.zeros((len(times), NUM_ACTUATED, 3))


def _matrices(columns: np.ndarray) -> np.ndarray:
    """Return rotation matrices of their first two columns ``(..., 6)``."""
    x, y = columns[..., :3], columns[..., 3:]
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def _world(root: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors ``(n, k, 3)`` from the pelvis' axes to the world's."""
    return np.einsum("nij,nkj->nki", root, vectors)
