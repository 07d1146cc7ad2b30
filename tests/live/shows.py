"""Changes that a browser would make to a show, through the library's handles, and readings of a show."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import numpy as np

from piavatar_envs.live.show import Show


def change(show: Show, name: str, value: object = None, client: int | None = None) -> None:
    """Change a control as a browser does: set its value, then call its callbacks; one turn later it is obeyed."""
    handle = show.panel.handles[name]
    if value is not None:
        handle._impl.value = value
    for call in handle._impl.update_cb:
        asyncio.run(call(SimpleNamespace(target=handle, client_id=client)))
    show.turn()


def click(show: Show, origin: object, direction: object) -> None:
    """Click into the scene along a ray; one turn later it is obeyed."""
    event = SimpleNamespace(client_id=0, ray_origin=tuple(origin), ray_direction=tuple(direction))
    for entry in show.live.view.server.scene._scene_pointer_cb:
        asyncio.run(entry.callback(event))
    show.turn()


def table(show: Show) -> str:
    """Return the text of the table."""
    return show.panel._table.content


def steps_done(show: Show, env: int = 0) -> int:
    """Return the control steps of the present episode of an environment."""
    return int(show.host.read(lambda group: group.step_count)[env])


def values_of(show: Show, name: str) -> np.ndarray:
    """Return an array of the state of all environments."""
    return show.host.get_state()[name]
