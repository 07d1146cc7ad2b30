"""Agents of the live view: zero and random actions, clips, and those of the package ``agents`` where it is there."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.motion.library import list_motions, load_motion
from piavatar_envs.avatar.motion.motion import Motion
from piavatar_envs.avatar.types import ROOT_RATE

#: Module of agents that are not of this package, with a function ``live_agents(env_id, name)`` of more kinds by name.
MORE = "agents.live"
CLIP = "clip:"


class LiveAgent(Protocol):
    """Chooses the actions of all environments."""

    def begin(self, mask: np.ndarray) -> None:
        """Forget the episodes of the masked environments, where others begin."""
        ...

    def act(self, step: int) -> np.ndarray:
        """Return actions ``(num_envs, num_agents, action_size)``; ``step`` counts those of all episodes."""
        ...


@dataclass(frozen=True)
class AgentKind:
    """An agent by its name.

    Attributes:
        make: builds it for environments and a seed.
        needs: settings that it was made for, by name; others are left as they are.
        controls: modes of control that it can act under; an environment of another one is replaced by one of the first.
    """

    make: Callable[[EpisodeHost, int], LiveAgent]
    needs: Mapping[str, Any] = field(default_factory=dict)
    controls: tuple[str, ...] = ("pose", "pd", "torque")


class Still:
    """Zero actions: a commanded pose is held."""

    def __init__(self, host: EpisodeHost, _seed: int) -> None:
        self._shape = host.num_envs, host.num_agents, host.action_size

    def begin(self, mask: np.ndarray) -> None:
        """Do nothing."""

    def act(self, step: int) -> np.ndarray:
        """Return zeros."""
        return np.zeros(self._shape, np.float32)


class Uniform(Still):
    """Random actions, uniform in the action space, that follow from the seed and the number of the step."""

    def __init__(self, host: EpisodeHost, seed: int) -> None:
        super().__init__(host, seed)
        self._seed = seed

    def act(self, step: int) -> np.ndarray:
        """Draw actions."""
        return np.random.default_rng([self._seed, step]).uniform(-1.0, 1.0, self._shape).astype(np.float32)


class Clip(Still):
    """Follows the joints of a clip, over and over, as far as actions reach; it stays in its place.

    Under pose control an action turns each joint from the commanded pose towards that of the clip, under joint targets
    it is the pose itself. Height and tilt of the commanded pelvis, which have no action, are set to the clip's.
    """

    def __init__(self, host: EpisodeHost, motion: Motion) -> None:
        """Follow a motion from its beginning in every episode."""
        super().__init__(host, 0)
        first = host.groups[0]
        self._host, self._motion, self._mode = host, motion, first.control
        self._joints = [joint_index(name) for name in first.action_spec.joints]
        self._dt = host.config.physics.control_dt
        maps = first.action_map
        self._scale = maps.scale.numpy()[self._joints, None]
        self._lower, self._upper = (bound.numpy()[self._joints] for bound in (maps.lower, maps.upper))

    def act(self, step: int) -> np.ndarray:
        """Return actions towards the clip's next pose."""
        host, joints = self._host, self._joints
        times = (host.read(lambda group: group.step_count) + 1) * self._dt
        times = times if self._motion.loop else np.mod(times, self._motion.duration)
        rotations, _ = self._motion.sample(times)
        # the root's critically damped pull lags by two time constants
        coming = self._motion.sample(times + 2.0 / ROOT_RATE)
        wanted = Rotation.from_quat(rotations[:, joints].reshape(-1, 4), scalar_first=True)
        actions = np.zeros(self._shape, np.float32)
        for agent in range(host.num_agents):
            if self._mode == "pose":
                self._set_pelvis(agent, coming[0][:, 0], coming[1][:, 2])
                now = host.read(lambda group, own=agent: group.simulation.avatars[own].state.command_rotation)
                turn = Rotation.from_quat(now[:, joints].reshape(-1, 4)).inv() * wanted
                values = turn.as_rotvec().reshape(host.num_envs, -1, 3) / self._scale
            else:
                vectors = wanted.as_rotvec().reshape(host.num_envs, -1, 3)
                values = np.where(vectors > 0.0, vectors / self._upper, -vectors / self._lower)
            actions[:, agent, : 3 * len(joints)] = np.nan_to_num(np.clip(values, -1.0, 1.0)).reshape(host.num_envs, -1)
        return actions

    def _set_pelvis(self, agent: int, turns: np.ndarray, heights: np.ndarray) -> None:
        """Set tilt and height of an avatar's commanded pelvis in all environments; its heading and place stay.

        Args:
            agent: index of the avatar.
            turns: rotations of the clip's pelvis, wxyz, shape ``(num_envs, 4)``.
            heights: of its pelvis [m], shape ``(num_envs,)``.
        """
        first = 0
        for group in self._host.groups:
            own = slice(first, first + group.num_envs)
            first += group.num_envs
            state = group.simulation.avatars[agent].state
            places, rotations = state.command_root.numpy().copy(), state.command_rotation.numpy().copy()
            wanted = Rotation.from_quat(turns[own], scalar_first=True)
            ahead = heading(Rotation.from_quat(rotations[:, 0])) - heading(wanted)
            places[:, 2] = heights[own]
            rotations[:, 0] = (Rotation.from_euler("z", ahead) * wanted).as_quat()
            state.command_root.assign(places)
            state.command_rotation.assign(rotations)


def heading(rotations: Rotation) -> np.ndarray:
    """Return the angle about the vertical by which rotations turn the front, -y [rad], shape ``(n,)``."""
    front = rotations.apply([0.0, -1.0, 0.0])
    return np.arctan2(front[:, 0], -front[:, 1])


def _clip(name: str) -> AgentKind:
    def make(host: EpisodeHost, _seed: int) -> Clip:
        return Clip(host, load_motion(name, host.groups[0].simulation.asset, loop=True))

    return AgentKind(make, controls=("pose", "pd"))


def agent_kinds(env_id: str, name: str = "") -> dict[str, AgentKind]:
    """Return the agents that can play an environment, by name.

    Args:
        env_id: of the environment.
        name: of an agent that is to be among them, such as the folder of a training.

    Raises:
        ValueError: the folder holds no training that plays the environment.
    """
    kinds = {"random": AgentKind(Uniform), "zero": AgentKind(Still)}
    kinds |= {f"{CLIP}{name}": _clip(name) for name in list_motions() if ":" not in name}
    if find_spec(MORE.partition(".")[0]) and find_spec(MORE):
        kinds |= importlib.import_module(MORE).live_agents(env_id, name)
    return kinds


def find_agent(name: str, kinds: Mapping[str, AgentKind]) -> AgentKind:
    """Return an agent by its name.

    Raises:
        ValueError: there is none.
    """
    if name not in kinds:
        raise ValueError(f"no agent {name!r}; there are {', '.join(kinds)}")
    return kinds[name]
