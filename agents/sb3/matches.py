"""Evaluation of agents of a world: in cooperation, or in matches, in every seat."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from agents.evaluate import Agent, Episode, Evaluation, evaluate, random_agent, zero_agent
from agents.intervals import mean_and_interval, share_interval
from agents.sb3.config import TrainingConfig
from agents.sb3.policy import policy_agent
from agents.sb3.selfplay import Pool

PLAYERS = ("zero", "random", "trained")


@dataclass(frozen=True)
class Match:
    """Episodes in which a player sits among opponents, equally often in every seat.

    A game is won where the player has success in its last step and no opponent has, lost where it is the other way
    round, and else drawn.

    Attributes:
        player, opponent: names.
        seats: the player's place among the agents, of every game.
        games: as they ended.
    """

    player: str
    opponent: str
    seats: tuple[int, ...]
    games: tuple[Episode, ...]

    def row(self) -> dict[str, Any]:
        """Return the figures for a table or a JSON file."""
        won, lost, mine, theirs = [], [], [], []
        for seat, game in zip(self.seats, self.games, strict=True):
            success, others = game.agent_success[seat], np.delete(game.agent_success, seat)
            won.append(bool(success and not others.any()))
            lost.append(bool(others.any() and not success))
            mine.append(float(game.agent_totals[seat]))
            theirs.append(float(np.delete(game.agent_totals, seat).mean()))
        own, other = mean_and_interval(mine), mean_and_interval(theirs)
        return {
            "case": f"{self.player} against {self.opponent}",
            "win_rate": float(np.mean(won)),
            "win_interval": share_interval(won),
            "loss_rate": float(np.mean(lost)),
            "loss_interval": share_interval(lost),
            "draw_rate": 1.0 - float(np.mean(won)) - float(np.mean(lost)),
            "return_mean": own.mean,
            "return_interval": [own.low, own.high],
            "opponent_return_mean": other.mean,
            "opponent_return_interval": [other.low, other.high],
            "mean_steps": float(np.mean([game.steps for game in self.games])),
            "failures": sum(game.failure for game in self.games),
            "episodes": len(self.games),
            "first_seed": min(game.seed for game in self.games),
        }


def seated(agents: Sequence[Agent]) -> Agent:
    """Combine an agent for every seat into one of a whole world, observations ``(n, agents, size)``.

    Raises:
        ValueError: one that remembers; here an agent may sit in several seats.
    """
    if any(hasattr(agent, "begin") for agent in agents):
        raise ValueError("an agent with begin() remembers; only agents without memory can be seated")
    return lambda observation: np.stack([agent(observation[:, seat]) for seat, agent in enumerate(agents)], axis=1)


def play_cooperative(config: TrainingConfig, model: PPO, worlds: VecEnv) -> list[Evaluation]:
    """Evaluate zero actions, random actions and the trained policy, each in all seats."""
    agents, size = worlds.action_space.shape
    return [
        evaluate(
            name,
            seated([_player(name, size, config, model)] * agents),
            worlds,
            config.evaluation.episodes,
            config.evaluation.first_seed,
        )
        for name in PLAYERS
    ]


def play_matches(config: TrainingConfig, model: PPO, pool: Pool, worlds: VecEnv) -> list[Match]:
    """Play zero actions, random actions and the trained policy against each configured opponent."""
    size = worlds.action_space.shape[1]
    matches = []
    for opponent in config.selfplay.evaluate_against:
        for player in PLAYERS:
            if player == opponent:
                continue
            if opponent in ("first", "latest"):
                policy = copy.deepcopy(model.policy)
                pool.load(policy, pool.steps[0 if opponent == "first" else -1])
                other = policy_agent(policy)
            else:
                other = _player(opponent, size, config, model)
            matches.append(_match((player, _player(player, size, config, model)), (opponent, other), config, worlds))
    return matches


def _player(name: str, size: int, config: TrainingConfig, model: PPO) -> Agent:
    if name == "trained":
        return policy_agent(model)
    return zero_agent(size) if name == "zero" else random_agent(size, config.evaluation.first_seed)


def _match(player: tuple[str, Agent], opponent: tuple[str, Agent], config: TrainingConfig, worlds: VecEnv) -> Match:
    agents = worlds.action_space.shape[0]
    each = -(-config.evaluation.episodes // agents)
    seats: list[int] = []
    games: list[Episode] = []
    for seat in range(agents):
        table = [opponent[1]] * agents
        table[seat] = player[1]
        name = f"{player[0]} against {opponent[0]}"
        first_seed = config.evaluation.first_seed + seat * each
        games += evaluate(name, seated(table), worlds, each, first_seed).episodes
        seats += [seat] * each
    return Match(player[0], opponent[0], tuple(seats), tuple(games))
