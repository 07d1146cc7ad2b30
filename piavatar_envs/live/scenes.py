"""Saved scenes of the live view: a file that goes on where it was saved, and a link that opens it.

A file is an ``.npz`` of the state of all environments and, as JSON, of what they were built from. On a CPU it goes on
bit for bit, but for agents with a memory, which begin anew. Nothing in it is unpickled.
"""

from __future__ import annotations

import io
import json
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from piavatar_envs.config.load import plain
from piavatar_envs.core.reading import UNREADABLE
from piavatar_envs.live.setup import Setup

#: Version of the files; others are refused.
VERSION = 1
_ABOUT, _STATE = "about", "state/"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,80}")


@dataclass(frozen=True)
class SavedScene:
    """A scene as a file holds it.

    Attributes:
        setup: what the environments are built from.
        tuned: settings that were changed while they ran, by name.
        env: index of the environment that is shown.
        color: of the bodies.
        played: control steps of all episodes.
        total: return of the episode that is shown.
        state: of all environments.
    """

    setup: Setup
    tuned: Mapping[str, float]
    env: int
    color: str
    played: int
    total: float
    state: Mapping[str, np.ndarray]

    def to_bytes(self) -> bytes:
        """Return the content of a file."""
        about = {
            "version": VERSION,
            **{name: getattr(self, name) for name in ("tuned", "env", "color", "played", "total")},
        }
        about = plain(about | {"setup": asdict(self.setup)})
        arrays = {f"{_STATE}{name}": value for name, value in self.state.items()}
        stream = io.BytesIO()
        np.savez_compressed(stream, **{_ABOUT: np.frombuffer(json.dumps(about).encode(), np.uint8)}, **arrays)
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> SavedScene:
        """Read the content of a file.

        Raises:
            ValueError: it is not a scene, or one of another version.
        """
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as file:
                arrays = dict(file)
            about = json.loads(arrays.pop(_ABOUT).tobytes())
            version = about.pop("version")
            about["setup"] = setup = Setup(**about["setup"])
            check_setup(setup)
            state = {name.removeprefix(_STATE): value for name, value in arrays.items()}
            scene = cls(**about, state=state)
        except (OSError, KeyError, TypeError, AttributeError, *UNREADABLE) as error:
            raise ValueError(f"this is not a scene of the live view ({type(error).__name__}: {error})") from None
        if version != VERSION:
            raise ValueError(f"this scene has version {version}, and this package reads {VERSION}")
        return scene


def read_scene(path: Path) -> SavedScene:
    """Read a scene from a file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is not a scene.
    """
    try:
        return SavedScene.from_bytes(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


class SceneFolder:
    """Scenes that were saved, by name.

    Attributes:
        folder: of the files; made with the first one.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def save(self, content: bytes, name: str) -> Path:
        """Write a scene under a name that no other has, and return its file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        stem, number = "".join(sign if _NAME.fullmatch(sign) else "-" for sign in name)[:60], 0
        while (path := self.folder / f"{stem}-{number}.npz").exists():
            number += 1
        path.write_bytes(content)
        return path

    def path(self, name: str) -> Path | None:
        """Return the file of a scene; None if there is none."""
        path = self.folder / f"{name}.npz"
        return path if _NAME.fullmatch(name) and path.is_file() else None


class LinkServer:
    """Answers addresses of saved scenes: each opens its scene, and leads to the view.

    Attributes:
        port: of this machine.
    """

    def __init__(self, view: str, folder: SceneFolder, open_scene: Callable[[Path], Any], port: int) -> None:
        """Start it in a thread.

        Args:
            view: address of the view.
            folder: of the scenes.
            open_scene: called in another thread with the file of a scene.
            port: the first that is tried.
        """

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                parts = urlsplit(self.path)
                name = parse_qs(parts.query).get("scene", [""])[0]
                path = folder.path(name) if parts.path == "/open" else None
                if path is None:
                    self.send_error(HTTPStatus.NOT_FOUND, "no such scene")
                # a page of another site must not change what is shown
                elif self.headers.get("Sec-Fetch-Site", "none") == "cross-site":
                    self.send_error(HTTPStatus.FORBIDDEN, "paste this address into the address bar")
                else:
                    open_scene(path)
                    self.send_response(HTTPStatus.SEE_OTHER)
                    self.send_header("Location", view)
                    self.end_headers()

            def log_message(self, *_arguments: Any) -> None:
                """Print nothing."""

        self._server = _bind(Handler, port)
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    def link(self, path: Path) -> str:
        """Return the address of a saved scene."""
        return f"http://127.0.0.1:{self.port}/open?scene={path.stem}"

    def close(self) -> None:
        """Stop it."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


def _bind(handler: type[BaseHTTPRequestHandler], port: int) -> ThreadingHTTPServer:
    """Return a server on a port of this machine, or on the next one that is free."""
    for free in range(port, port + 100):
        try:
            return ThreadingHTTPServer(("127.0.0.1", free), handler)
        except OSError:
            continue
    return ThreadingHTTPServer(("127.0.0.1", 0), handler)


def check_setup(setup: Setup) -> None:
    """Refuse a setup whose parts are of other types than those of :class:`Setup`.

    Raises:
        ValueError: one is.
    """
    kinds = {
        "env_id": str,
        "settings": Mapping,
        "agent": str,
        "num_envs": int,
        "seed": int,
        "device": str,
        "ball": bool,
    }
    for one in fields(setup):
        if not isinstance(getattr(setup, one.name), kinds[one.name]):
            raise ValueError(f"{one.name}={getattr(setup, one.name)!r} of the scene is no {kinds[one.name].__name__}")
