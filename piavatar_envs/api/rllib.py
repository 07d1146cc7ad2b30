"""Views for RLlib beside the registered ids: games with true ends, and seeds that no two env runners share.

Avatars that act alone need neither: ``PPOConfig().environment("piavatar_envs:PIAvatar/Reach-v0")``. Games::

    from ray.tune.registry import register_env
    from piavatar_envs.api.rllib import multi_agent_env
    register_env("game", multi_agent_env)
    config = PPOConfig().environment("game", env_config={"game": "sumo_v0", "fidelity": "tiny"})

RLlib is imported when a game is built.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from piavatar_envs.api.pettingzoo import AvatarParallelEnv
from piavatar_envs.core.extras import MissingExtra, missing
from piavatar_envs.tasks.games import load_game_task

try:
    from pettingzoo.utils import BaseParallelWrapper
except ImportError as error:
    raise missing("this view", "PettingZoo", "multi") from error

#: Added by RLlib to the seeds of its evaluations.
_EVALUATION_SEED = 1_000_000


class JointTruncation(BaseParallelWrapper):
    """A parallel environment whose truncation concerns all agents at once, for RLlib's ``ParallelPettingZooEnv``.

    RLlib's ``MultiAgentEpisode.add_env_step`` takes an episode whose agents were truncated one by one for terminated,
    and would learn that nothing follows the end of the clock. And where some agents terminate in the very step in which
    the clock ends for the others, its wrapper reports no end. Without truncations of single agents, the wrapper reports
    the one of all agents, and both is right.
    """

    def step(self, actions: Mapping[str, Any]) -> tuple[dict[str, Any], ...]:
        """Advance by one control step; the truncations are empty where the clock has ended the episode."""
        observations, rewards, terminations, truncations, infos = self.env.step(actions)
        return observations, rewards, terminations, {} if any(truncations.values()) else truncations, infos


def multi_agent_env(config: Mapping[str, Any]) -> Any:
    """Build a game as an RLlib ``MultiAgentEnv``, for ``ray.tune.registry.register_env``.

    Args:
        config: RLlib's ``env_config``: ``game``, such as ``"sumo_v0"`` (``"module:name"`` imports the module first),
            and settings of :class:`~piavatar_envs.api.pettingzoo.AvatarParallelEnv`.

    Raises:
        ConfigError: a setting that is unknown (a TypeError, too), of the wrong type or out of range.
        ImportError: RLlib is not installed.
        ValueError: no game is named, or one that there is not.
    """
    try:
        from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    except ImportError as error:
        raise MissingExtra("this view needs RLlib, the package ray[rllib]; docs/rllib.md has its versions") from error
    settings = dict(config)
    if "game" not in settings:
        raise ValueError('env_config names no game; give it one, as in env_config={"game": "sumo_v0"}')
    name = settings.pop("game")
    game = AvatarParallelEnv(load_game_task(name), name=name.rpartition(":")[2], **settings)
    return ParallelPettingZooEnv(JointTruncation(game))


def distinct_seeds(*, env_runner: Any, **_: Any) -> None:
    """Give the environments of an env runner seeds of their own; RLlib's callback ``on_environment_created``.

    RLlib seeds environment ``i`` of env runner ``w`` with ``seed + w + i``, so that neighbours play almost the same
    episodes. With this callback env runners take consecutive ranges, as one batch of all environments would::

        config.debugging(seed=7).callbacks(on_environment_created=distinct_seeds)

    Without a seed in the configuration it changes nothing: then no two environments are alike.

    Args:
        env_runner: of one or of several agents.
        **_: other arguments of the callback.
    """
    config = env_runner.config
    if config.seed is not None:
        before = max((env_runner.worker_index or 0) - 1, 0) * config.num_envs_per_env_runner
        env_runner._seed = config.seed + _EVALUATION_SEED * bool(config.in_evaluation) + before
