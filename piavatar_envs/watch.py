"""Endless play of an environment in a web browser, of one agent or several, with a control panel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import gymnasium
import numpy as np

from piavatar_envs.api.pictures import Live
from piavatar_envs.envs.task import REWARD
from piavatar_envs.play import JointEnv, check_agent, make, numbers, settings_of
from piavatar_envs.render.live import PORT, check_port, import_viser
from piavatar_envs.render.panel import Panel

#: From an observation (None where there are several agents) to an action.
Act = Callable[[Any], np.ndarray]
#: Time between two looks at the panel while nothing moves, and between two tables [s].
_REST, _TABLE_EVERY = 0.05, 0.2


def watch(
    env_id: str,
    agent: str = "random",
    seed: int = 0,
    device: str = "cpu",
    port: int = PORT,
    overrides: Mapping[str, Any] | None = None,
) -> None:
    """Play ``env_id`` in a web browser until Ctrl-C, then say how long it was.

    Args:
        env_id: a registered id, or a module of several agents such as ``sumo_v0``, with or without its package.
        agent: "random" (uniform in the action space) or "zero".
        seed: of the first reset and of the random actions; later episodes go on from it.
        device: a Warp device.
        port: of this machine, or the next one that is free.
        overrides: settings of the environment's configuration.

    Raises:
        ImportError: the extra ``live`` is not installed.
        ValueError: an unknown module or agent, a seed, a port or a setting out of range.
    """
    check_agent(agent, seed)
    check_port(port)
    settings = settings_of(device, overrides)
    import_viser()  # before the kernels are compiled
    env = make(env_id, settings)
    env.action_space.seed(seed)
    still = np.zeros(env.action_space.shape, env.action_space.dtype)
    watch_env(env, lambda _observation: env.action_space.sample() if agent == "random" else still, seed, port)


def watch_env(
    env: gymnasium.Env | JointEnv,
    act: Act,
    seed: int = 0,
    port: int = PORT,
    begin: Callable[[], None] = lambda: None,
) -> None:
    """Play in a web browser until Ctrl-C; then close the environment and say in a line how long it was.

    Args:
        env: made without a render mode.
        act: chooses the actions.
        seed: of the first reset.
        port: of this machine, or the next one that is free.
        begin: called before every episode.

    Raises:
        ImportError: the extra ``live`` is not installed.
        ValueError: a port out of range.
    """
    try:
        inner = env.unwrapped
        live = Live(inner.batch, inner.apply_force, inner.config.render.color, port)
        try:
            show = None
            with suppress(KeyboardInterrupt):
                show = Show(env, act, begin, live)
                show.begin(seed)
                while True:
                    show.turn()
            print(f"\nended after {show.played if show else 0} steps; the same command begins again")
        finally:
            live.close()
    finally:
        env.close()


class Show:
    """Endless play, a turn at a time.

    Attributes:
        panel: the controls in the browser.
        played: number of steps of all episodes.
    """

    def __init__(self, env: gymnasium.Env | JointEnv, act: Act, begin: Callable[[], None], live: Live) -> None:
        """Open the view and its panel; :meth:`begin` comes next."""
        self.panel = Panel(live.view.server, live.color)
        self._env, self._act, self._begin, self._live = env, act, begin, live
        self._name = env.name if isinstance(env, JointEnv) else env.spec.id
        self._dt = env.unwrapped.config.physics.control_dt
        self._over, self.played = False, 0

    def begin(self, seed: int | None = None) -> None:
        """Begin an episode: of ``seed``, or the next one."""
        self._begin()
        self._observation, _ = self._env.reset(seed=seed)
        self._over, self._steps, self._return, self._info = False, 0, 0.0, {}
        self._live.begin()
        self._fill_table()

    def turn(self) -> None:
        """Step, begin an episode or, while paused, rest."""
        panel, live = self.panel, self._live
        if panel.take_episode():
            self.begin()
        if panel.color != live.color:
            live.color = panel.color
            live.show()
        if not panel.take_step():
            live.catch_up()
            live.pace.rest(_REST)
            return
        if self._over:
            self.begin()
        action = self._act(self._observation)
        live.before_step()
        self._observation, reward, terminated, truncated, self._info = self._env.step(action)
        self._steps += 1
        self.played += 1
        self._return += float(reward)
        self._over = terminated or truncated
        live.step(panel.speed)
        if self._over or not panel.playing or live.pace.clock() - self._table_at >= _TABLE_EVERY:
            self._fill_table()

    def _fill_table(self) -> None:
        """Fill the table; not in every step, because a browser takes longer for it than for the scene."""
        self._table_at = self._live.pace.clock()
        terms = {
            name.replace(REWARD, ""): f"{value:+.3f}"
            for name, value in numbers(self._info).items()
            if name.rpartition(".")[2].startswith(REWARD)
        }
        about = {"step": str(self._steps), "time": f"{self._steps * self._dt:.2f} s", "return": f"{self._return:.2f}"}
        self.panel.show_table(self._name, about | terms)
