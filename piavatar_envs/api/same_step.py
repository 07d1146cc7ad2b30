"""SAME_STEP autoreset: an environment that ends begins its next episode within the step, and its end is not lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from piavatar_envs.api.arrays import Array
from piavatar_envs.api.batched import BatchedEpisodes
from piavatar_envs.api.infos import outcome, standing


@dataclass(frozen=True)
class Transition:
    """A control step of all environments, after which those that ended stand at the start of their next episode.

    Attributes:
        observation: from which the next step begins, ``(num_envs, num_agents, observation_size)``.
        final_observation: to which this step led; where nothing ended it is the same.
        reward: ``(num_envs, num_agents)``; zero for an agent that was out before.
        terminated: ``(num_envs, num_agents)`` bool; stays True while the others go on.
        truncated: ``(num_envs, num_agents)`` bool, the clock has run out for an agent that was still in.
        ended: ``(num_envs,)`` bool, whose next episode has begun: the last agent is out, or the clock has run out.
        acted: ``(num_envs, num_agents)`` bool, who was in when the step began.
        infos: of every agent, a row an environment, as they were when the step ended.
    """

    observation: Array
    final_observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    ended: Array
    acted: Array
    infos: Sequence[dict[str, Any]]


def step_and_reset(episodes: BatchedEpisodes, actions: Array) -> Transition:
    """Advance all environments, and begin the next episode of those that end.

    Args:
        episodes: the environments.
        actions: as :meth:`~piavatar_envs.api.batched.BatchedEpisodes.step` takes them.

    Raises:
        ValueError: actions of a wrong shape, type or device; nothing has changed then.
        gymnasium.error.ResetNeeded: before the first reset.
    """
    episodes.check_ready("step")
    acted = episodes.alive()
    episodes.step(actions)
    terminated, final = episodes.terminated(), episodes.observation()
    truncated = episodes.truncated()[:, None] & ~terminated
    infos = [
        standing(episodes.read, episodes.api, agent) | outcome(episodes.read, episodes.task, agent)
        for agent in range(episodes.num_agents)
    ]
    ended = episodes.find_ended()
    episodes.reset_ended()
    return Transition(episodes.observation(), final, episodes.reward(), terminated, truncated, ended, acted, infos)


def means(infos: Sequence[dict[str, Any]], metrics: Sequence[str]) -> dict[str, Array]:
    """Means over environments and agents of what loggers show: success, the reward's terms and the metrics, by name.

    Args:
        infos: of a :class:`Transition` of tensors.
        metrics: names of the task's metrics.
    """
    terms = infos[0]["reward_terms"]
    shown = {"Task/success": [info["success"].float() for info in infos]}
    shown |= {f"Task/{name}": [info[name] for info in infos] for name in metrics}
    shown |= {f"Reward/{name}": [info["reward_terms"][name] for info in infos] for name in terms}
    return {
        name: sum(value.nan_to_num(0.0, 0.0, 0.0).mean() for value in values) / len(infos)
        for name, values in shown.items()
    }
