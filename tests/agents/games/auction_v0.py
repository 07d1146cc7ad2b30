"""Competition: in each of some rounds the higher bid wins a point, and every bid costs what it is worth."""

from __future__ import annotations

from pydantic import Field

from piavatar_envs.config import EnvConfig
from tests.agents.games.game import Game


class Config(EnvConfig):
    rounds: int = Field(4, ge=1, description="length of a game")
    cost: float = Field(0.1, ge=0.0, description="of the highest bid, in points")


class Auction(Game):
    """Observed: the share of rounds played, and the lead. An action of 1 is the highest bid."""

    observed = ("played", "lead")
    Config = Config

    def begin(self, rng):
        self.points = dict.fromkeys(self.names, 0.0)

    def _lead(self, name):
        return self.points[name] - self.points[self.names[1 - self.names.index(name)]]

    def observe(self, name):
        return [self.time / self.config.rounds, self._lead(name)]

    def play(self, actions):
        best = max(actions.values())
        winners = [name for name, action in actions.items() if action == best]
        for name in winners:
            self.points[name] += 1.0 / len(winners)
        rewards = {
            name: (name in winners) / len(winners) - self.config.cost * (1.0 + action) / 2.0
            for name, action in actions.items()
        }
        over = self.time == self.config.rounds
        infos = {name: {"success": over and self._lead(name) > 0.0} for name in actions}
        return rewards, dict.fromkeys(actions, over), dict.fromkeys(actions, False), infos


TASK = Auction


def parallel_env(**settings) -> Auction:
    return Auction(**settings)
