"""Everything about a step can be read off its observation and its reward, and agents leave one after the other."""

from __future__ import annotations

from tests.agents.games.game import Game

LEAVES = {"a": 5, "b": 2, "c": 3}  # the step in which an agent's part ends
TERMINATED = "b"  # the others are truncated


class Ledger(Game):
    """Three agents: an observation says who sees it and when, a reward is 100 * agent + 10 * time + action."""

    names = ("a", "b", "c")
    observed = ("seed", "episode", "agent", "time")

    def observe(self, name):
        return [self.seed, self.episode, self.names.index(name), self.time]

    def play(self, actions):
        rewards = {name: 100.0 * self.names.index(name) + 10.0 * self.time + a for name, a in actions.items()}
        over = {name: self.time == LEAVES[name] for name in actions}
        terminations = {name: over[name] and name == TERMINATED for name in actions}
        truncations = {name: over[name] and name != TERMINATED for name in actions}
        return rewards, terminations, truncations, {name: {"success": name == "c", "name": name} for name in actions}


TASK = Ledger


def parallel_env(**settings) -> Ledger:
    return Ledger(**settings)
