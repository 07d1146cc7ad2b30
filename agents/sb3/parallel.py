"""Worlds of several agents as stable-baselines3 wants them: agents folded into the batch, one network for all.

A :class:`World` is a PettingZoo parallel environment as one Gymnasium environment, so that it runs in the same worker
processes as a single agent's. An :class:`AgentVecEnv` shows every learning agent of every world as a slot of its own.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from piavatar_envs.config import ConfigError, EnvConfig
from piavatar_envs.doctor import quiet_warp
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.multi import load_game

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

    from agents.sb3.selfplay import Opponents

#: in the info of a step that a slot did not take: its agent had left while its world went on
WAITING = "waiting"


class World(gym.Env):
    """All agents of a world as one environment: observations ``(agents, size)``, actions ``(agents, size)``.

    The reward is the mean of the agents' own, so is ``distance`` where they have one, and ``success`` is that of all.
    What belongs to single agents is in ``info``, in the order of ``names``: ``played`` (whether it took this step),
    ``rewards``, ``terminated``, ``truncated``, ``successes`` (the latest, also of agents that left) and
    ``agent_infos``. An agent that has left keeps its last observation, and its actions are ignored. The world ends
    with its last agent.
    """

    def __init__(self, env: ParallelEnv) -> None:
        """Wrap a world.

        Raises:
            ConfigError: the agents' spaces differ, and one network cannot serve them all.
        """
        self.env = env
        self.names: tuple[str, ...] = tuple(env.possible_agents)
        first = self.names[0]
        for name in self.names:
            for space in (env.observation_space, env.action_space):
                if space(name) != space(first):
                    raise ConfigError(f"{name} has {space(name)}, {first} has {space(first)}; agents must be alike")
        batch = gym.vector.utils.batch_space
        self.observation_space = batch(env.observation_space(first), len(self.names))
        self.action_space = batch(env.action_space(first), len(self.names))
        self.render_mode = env.unwrapped.render_mode

    @property
    def config(self) -> EnvConfig:
        """Return the settings of the world."""
        return self.env.unwrapped.config

    @property
    def observation_layout(self) -> ObservationLayout:
        """Return the layout of an agent's observation."""
        return self.env.unwrapped.observation_layout

    @property
    def action_names(self) -> tuple[str, ...]:
        """Return the names of the components of an agent's action."""
        return self.env.unwrapped.action_names

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode: of ``seed``, or the next one of the previous seed."""
        observations, _ = self.env.reset(seed=seed, options=options)
        self._observation = np.stack([observations[name] for name in self.names])
        self._successes = np.zeros(len(self.names), bool)
        return self._observation.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance by one control step."""
        playing = {name: action[i] for i, name in enumerate(self.names) if name in self.env.agents}
        observations, rewards, terminations, truncations, infos = self.env.step(playing)
        agent_infos = [infos.get(name, {}) if name in playing else {} for name in self.names]
        for i, name in enumerate(self.names):
            if name in playing:
                self._observation[i] = observations[name]
                self._successes[i] = agent_infos[i].get("success", False)
        info = {
            "played": np.array([name in playing for name in self.names]),
            "rewards": self._rows(rewards, playing, np.float64),
            "terminated": self._rows(terminations, playing, bool),
            "truncated": self._rows(truncations, playing, bool),
            "successes": self._successes.copy(),
            "agent_infos": agent_infos,
            "success": bool(self._successes.all()),
            "failure": next((info["failure"] for info in agent_infos if info.get("failure")), 0),
        }
        distances = [info["distance"] for info in agent_infos if "distance" in info]
        if distances:
            info["distance"] = float(np.mean(distances))
        over = not self.env.agents
        terminated = over and bool(info["terminated"].any())
        return self._observation.copy(), float(info["rewards"].mean()), terminated, over and not terminated, info

    def get_state(self) -> dict[str, Any]:
        """Return everything that the future depends on."""
        return {"env": self.env.get_state(), "seen": self._observation.copy(), "successes": self._successes.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned.

        Raises:
            ValueError: the state is of another world.
        """
        self.env.set_state(state["env"])
        self._observation, self._successes = state["seen"].copy(), state["successes"].copy()

    def _rows(self, values: dict[str, Any], playing: dict[str, Any], dtype: type) -> np.ndarray:
        return np.array([values[name] if name in playing else 0 for name in self.names], dtype)

    def render(self) -> np.ndarray | None:
        """Render a picture of the world."""
        return self.env.render()

    def close(self) -> None:
        """Free the world."""
        self.env.close()


@dataclass(frozen=True)
class WorldFactory:
    """Factory of one world, in whichever process calls it.

    Attributes:
        game: its name, or a module that has ``parallel_env``.
        settings: of the world.
        device: Warp's.
        render_mode: None or ``"rgb_array"``.
    """

    game: str
    settings: dict[str, Any]
    device: str = "cpu"
    render_mode: str | None = None

    def __call__(self) -> World:
        """Build the world."""
        quiet_warp()
        game = importlib.import_module(self.game) if "." in self.game else load_game(self.game)
        make: Callable[..., ParallelEnv] = game.parallel_env
        return World(make(config=self.settings, device=self.device, render_mode=self.render_mode))


class AgentVecEnv(VecEnv):
    """Worlds with a slot per learning agent; an episode of a slot lasts from the world's reset until its agent leaves.

    In most worlds all agents learn. The last ``num_duels`` worlds have one learner each, in a seat that is drawn for
    every episode; for the other agents act ``opponents``, which need no slot. A world is reset as soon as no learner
    plays in it. Until then the slot of an agent that has left *waits*: each such step is done, pays nothing and has
    ``info["waiting"]``, so that no value flows through it and :class:`~agents.sb3.ppo.PlayedBuffer` drops it.
    """

    def __init__(self, worlds: VecEnv, num_duels: int = 0) -> None:
        """Give every learning agent of the worlds a slot.

        Args:
            worlds: of :class:`World` environments.
            num_duels: how many of them have one learner only.

        Raises:
            ValueError: more duels than worlds, or worlds of one agent.
        """
        agents = worlds.observation_space.shape[0]
        if not 0 <= num_duels <= worlds.num_envs or (num_duels and agents < 2):
            raise ValueError(f"{num_duels} duels in {worlds.num_envs} worlds of {agents} agents")
        self.worlds, self.num_agents = worlds, agents
        self.first_duel = worlds.num_envs - num_duels
        self.opponents: Opponents | None = None
        self.rng = np.random.default_rng()
        folded, alone = np.arange(self.first_duel), np.arange(self.first_duel, worlds.num_envs)
        self.slot_world = np.concatenate([np.repeat(folded, agents), alone])
        self.slot_agent = np.concatenate([np.tile(np.arange(agents), self.first_duel), np.zeros_like(alone)])
        observed, acted = worlds.observation_space, worlds.action_space
        super().__init__(
            len(self.slot_world),
            gym.spaces.Box(observed.low[0], observed.high[0], dtype=observed.dtype),
            gym.spaces.Box(acted.low[0], acted.high[0], dtype=acted.dtype),
        )

    @property
    def duels(self) -> range:
        """Return the worlds with one learner."""
        return range(self.first_duel, self.worlds.num_envs)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed world ``w`` with ``seed + w``; seats and opponents are drawn anew, by ``seed`` too."""
        self.rng = np.random.default_rng(seed)
        return self.worlds.seed(seed)

    def reset(self) -> np.ndarray:
        """Begin an episode in every world."""
        if self.duels and self.opponents is None:
            raise RuntimeError(f"{len(self.duels)} worlds wait for opponents; set .opponents before reset()")
        self._observation = self.worlds.reset()
        for world in self.duels:
            self._take_seats(world)
        return self._observation[self.slot_world, self.slot_agent]

    def step_async(self, actions: np.ndarray) -> None:
        """Send the learners' actions and the opponents'."""
        joint = np.zeros((self.worlds.num_envs, *self.worlds.action_space.shape), np.float32)
        joint[self.slot_world, self.slot_agent] = actions
        for world in self.duels:
            others = np.arange(self.num_agents) != self.slot_agent[self._duel_slot(world)]
            joint[world, others] = self.opponents.act(world, self._observation[world, others])
        self.worlds.step_async(joint)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Return the learners' outcomes."""
        self._observation, _, over, world_infos = self.worlds.step_wait()
        rewards, dones = np.zeros(self.num_envs, np.float32), np.ones(self.num_envs, bool)
        infos: list[dict[str, Any]] = []
        for slot, (world, agent) in enumerate(zip(self.slot_world, self.slot_agent, strict=True)):
            outcome = world_infos[world]
            if not outcome["played"][agent]:
                infos.append({WAITING: True})
                continue
            terminated, truncated = bool(outcome["terminated"][agent]), bool(outcome["truncated"][agent])
            rewards[slot], dones[slot] = outcome["rewards"][agent], terminated or truncated
            info = {**outcome["agent_infos"][agent], "TimeLimit.truncated": truncated and not terminated}
            if dones[slot]:
                # a world that is over has been reset by its worker, which kept the last observations
                final = outcome["terminal_observation"] if over[world] else self._observation[world]
                info["terminal_observation"] = final[agent].copy()
            infos.append(info)
        for world in self.duels:
            if dones[self._duel_slot(world)]:
                if not over[world]:
                    self._observation[world] = self.worlds.env_method("reset", indices=world)[0][0]
                self._take_seats(world)
        return self._observation[self.slot_world, self.slot_agent], rewards, dones, infos

    def get_state(self) -> dict[str, Any]:
        """Return seats, opponents and the latest observations; the worlds have states of their own."""
        return {
            "seen": self._observation.copy(),
            "seats": self.slot_agent.copy(),
            "random": self.rng.bit_generator.state,
            "drawn": dict(self.opponents.drawn) if self.opponents else {},
            "pool": list(self.opponents.pool.steps) if self.opponents else [],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned; the pool of the opponents must be as it was."""
        self._observation, self.slot_agent = state["seen"].copy(), state["seats"].copy()
        self.rng.bit_generator.state = state["random"]
        if self.opponents:
            self.opponents.seat(state["drawn"])

    def _duel_slot(self, world: int) -> int:
        return self.num_envs - self.worlds.num_envs + world

    def _take_seats(self, world: int) -> None:
        self.slot_agent[self._duel_slot(world)] = self.rng.integers(self.num_agents)
        self.opponents.draw(world, self.rng)

    def _worlds_of(self, indices: int | Sequence[int] | None) -> list[int]:
        return [int(self.slot_world[slot]) for slot in self._get_indices(indices)]

    def close(self) -> None:
        """Close the workers."""
        self.worlds.close()

    def get_attr(self, attr_name: str, indices: int | Sequence[int] | None = None) -> list[Any]:
        """Return an attribute of the slots' worlds."""
        return self.worlds.get_attr(attr_name, self._worlds_of(indices))

    def set_attr(self, attr_name: str, value: Any, indices: int | Sequence[int] | None = None) -> None:
        """Set an attribute of the slots' worlds."""
        self.worlds.set_attr(attr_name, value, self._worlds_of(indices))

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the slots' worlds."""
        return self.worlds.env_method(method_name, *args, indices=self._worlds_of(indices), **kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """Return whether the slots' worlds are wrapped."""
        return self.worlds.env_is_wrapped(wrapper_class, self._worlds_of(indices))
