"""Cooperation: two on a line are paid for being close, and one who runs off it has left."""

from __future__ import annotations

from pydantic import Field

from piavatar_envs.config import EnvConfig
from tests.agents.games.game import Game


class Config(EnvConfig):
    steps: int = Field(16, ge=1, description="length of an episode")


class Rendezvous(Game):
    """Observed: the own place, the way to the other one. An action moves by a quarter at most."""

    observed = ("place", "way")
    Config = Config

    def begin(self, rng):
        self.place = dict(zip(self.names, rng.uniform(-1.0, 1.0, 2), strict=True))

    def observe(self, name):
        other = self.names[1 - self.names.index(name)]
        return [self.place[name], self.place[other] - self.place[name]]

    def play(self, actions):
        for name, action in actions.items():
            self.place[name] += 0.25 * action
        distance = abs(self.place["left"] - self.place["right"])
        terminations = {name: abs(self.place[name]) > 2.0 for name in actions}
        truncations = {name: self.time == self.config.steps for name in actions}
        infos = {name: {"success": distance < 0.1} for name in actions}
        return {name: -distance for name in actions}, terminations, truncations, infos


TASK = Rendezvous


def parallel_env(**settings) -> Rendezvous:
    return Rendezvous(**settings)
