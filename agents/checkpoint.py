"""The checkpoint of a training run: one file, written atomically, that names the run it belongs to.

A killed run resumes from it, and on the same CPU (with as many threads for torch) gives the same curve and the same
networks, bit for bit, as one without the interruption. A checkpoint therefore holds everything that the future depends
on: networks, optimizers, random numbers, environments (0.4 MB each at ``fidelity="coarse"``), remembered steps, what
the learner saw last, and the curve so far. It is read without running code that it might carry
(``torch.load(weights_only=True)``).

A training run of several ranks has one file, too: rank 0 writes and reads it, and exchanges the states with the others.

A training run whose parameters or outputs are no longer finite ends in an error before it writes anything.
"""

from __future__ import annotations

import random
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel

from agents.files import CHECKPOINT, POLICIES, RESULTS, git_commit, hold, write_atomically
from agents.interrupt import StopRequest
from agents.ranks import ALONE, Ranks
from piavatar_envs.config import ConfigError
from piavatar_envs.core.reading import UNREADABLE, first_line
from piavatar_envs.doctor import package_version

#: Of the file's content; rises with every change.
FORMAT = 5
#: Settings that what has been learned so far does not depend on.
FREE = ("total_steps", "iterations", "checkpoint_every", "evaluation", "env.render")
#: Of these, how long a training run is, and the settings that change with how much of it is over: where there is one,
#: what has been learned so far does depend on the length.
LENGTHS, FALLING = ("total_steps", "iterations"), ("ppo.final_kl", "ppo.final_learning_rate")
#: Packages whose version the arithmetic depends on.
PACKAGES = (
    "piavatar-envs", "numpy", "torch", "warp-lang", "gymnasium", "pettingzoo", "stable-baselines3", "rsl-rl-lib",
)  # fmt: skip


class Checkpoint:
    """Checkpoint of a run: the state that it resumes from, and the file for the next one.

    Attributes:
        path: of the file.
        state: what it held when the run began, or None for a run from the start.
        reached: how long the training was that the file holds; empty without a file.
        stop: by which the training ends once it is written.
        ranks: of the training.
    """

    def __init__(
        self, folder: Path, script: str, config: BaseModel, device: str, resume: bool, ranks: Ranks = ALONE
    ) -> None:
        """Read the checkpoint of a folder, or prepare for a new training.

        Args:
            folder: of the run; exists where rank 0 is.
            script: that trains.
            config: resolved.
            device: where it simulates and learns, as it was asked for.
            resume: whether to go on from what the folder holds; where it holds nothing, the run begins.
            ranks: all of which build one.

        Raises:
            ConfigError: a checkpoint of another configuration, device or version, or one that cannot be read; or
                there is one, and ``resume`` was not asked for; or the folder is that of another training run, which is
                still going on or was kept without its checkpoint.
        """
        self.path = folder / CHECKPOINT
        self.reached, self.stop, self.ranks = "", StopRequest(ranks), ranks
        commit, _ = git_commit()
        self._about = {
            "script": script,
            "device": device,
            "config": config.model_dump(mode="json"),
            "versions": {name: package_version(name) for name in PACKAGES},
            "commit": commit,
            "ranks": ranks.size,
        }
        self.state: dict[str, Any] | None = ranks.scatter(self._open(folder, resume) if ranks.first else [])
        if self.state is not None:
            self.reached = self._length(self.state)

    def _open(self, folder: Path, resume: bool) -> list[dict[str, Any] | None]:
        """Lock the folder, and return the state that each rank resumes from."""
        hold(folder)
        if not self.path.exists():
            for name in (*POLICIES, RESULTS):
                if (folder / name).exists():
                    raise ConfigError(
                        f"{folder / name} is of a training run that has ended; write elsewhere with --out"
                    )
            return [None] * self.ranks.size
        if not resume:
            raise ConfigError(
                f"{folder} holds a training run already; go on with --resume, write to another folder with --out, or "
                f"delete {self.path} to lose it"
            )
        content = read_checkpoint(self.path)
        self._compare(content["about"])
        return [content["state"], *(content["state"] | own for own in content.get("others", ()))]

    def save(self, shared: Mapping[str, Any], own: Mapping[str, Any] | None = None) -> None:
        """Replace the saved state by a new one: nested containers of tensors, arrays and plain values.

        Args:
            shared: the same on all ranks, which all save.
            own: this rank's, resumed from as if they were one.
        """
        parts = self.ranks.gather(as_tensors(own or {}))
        self.reached = self._length(shared)
        if self.ranks.first:
            state = as_tensors(shared) | parts[0]
            content = {"format": FORMAT, "about": self._about, "state": state, "others": parts[1:]}
            write_atomically(self.path, lambda file: torch.save(content, file))

    def remedy(self, command: str) -> str:
        """Return what an interrupted training run has reached, and how to go on.

        Args:
            command: line that resumes it.
        """
        if not self.reached:
            return f"before the first checkpoint; nothing is kept, begin anew with {command}"
        return f"after {self.reached}; go on with {command}"

    def _length(self, state: Mapping[str, Any]) -> str:
        """Return the length of a training run in this state, for messages."""
        for unit, length in (("steps", "total_steps"), ("iterations", "iterations")):
            if unit in state:
                return f"{state[unit]} of {self._about['config'][length]} {unit}"
        return ""

    def _compare(self, was: dict[str, Any]) -> None:
        """Refuse a checkpoint that another version, configuration, script or device wrote."""
        for section, remedy in (
            ("versions", "install that version, or begin anew in another folder with --out"),
            ("config", "give the same settings, or begin anew in another folder with --out"),
        ):
            before, now = was[section], self._about[section]
            unlike = settings_changed(before, now) if section == "config" else differences(before, now)
            for name, old, new in unlike:
                raise ConfigError(f"{self.path} was written with {name}={old}, now it is {new}; {remedy}")
        for name in ("script", "device"):
            if was[name] != self._about[name]:
                raise ConfigError(
                    f"{self.path} was written with {name} {was[name]!r}, now it is {self._about[name]!r}; use the same"
                )
        if (before := was.get("ranks", 1)) != self.ranks.size:
            raise ConfigError(
                f"{self.path} was written by {before} ranks, now there are {self.ranks.size}; start as many with "
                "torchrun, or begin anew in another folder with --out"
            )
        if was["commit"] != self._about["commit"]:
            warnings.warn(
                f"{self.path} was written by commit {was['commit']}, this is {self._about['commit']}: the curve may "
                "go on otherwise than it would have",
                stacklevel=4,
            )


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint: ``state``, and ``about`` the training that it is of.

    Raises:
        ConfigError: the file cannot be read, or has another format.
    """
    try:
        content = load_weights(path, "cpu")
    except UNREADABLE as error:
        raise ConfigError(f"{path} cannot be read ({first_line(error)}); delete it to begin anew") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else None
        raise ConfigError(f"{path} has format={found}, this reads {FORMAT}; delete it to begin anew")
    about, needed = content.get("about"), {"script", "device", "config", "versions", "commit"}
    if not (isinstance(about, dict) and needed <= about.keys() and isinstance(content.get("state"), dict)):
        raise ConfigError(f"{path} lacks the state or the description of a training run; delete it to begin anew")
    return content


def load_weights(path: Path, device: str) -> Any:
    """Load a file of ``torch.save`` without running code that it might contain, and verify its checksums.

    Raises:
        Exception: of :data:`piavatar_envs.core.reading.UNREADABLE`, the file is damaged or another's.
    """
    with zipfile.ZipFile(path) as archive:
        if (damaged := archive.testzip()) is not None:
            raise ValueError(f"{damaged} is damaged")
    return torch.load(path, map_location=device, weights_only=True)


def policy_mismatch(path: Path, seen: int, action_size: int, error: Exception) -> ConfigError:
    """Build the error for a file without a policy of ``seen`` inputs and ``action_size`` outputs."""
    size = f"that sees {seen} numbers and gives {action_size}"
    return ConfigError(f"{path} holds no policy of its config.yaml {size}: {first_line(error)}")


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return leaves of nested dictionaries by dotted name; empty dictionaries vanish."""
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            found |= flattened(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return dotted names of leaves that differ between two nested dictionaries, each with both values (or None)."""
    old, new = flattened(before), flattened(now)
    return [(name, old.get(name), new.get(name)) for name in sorted(old | new) if old.get(name) != new.get(name)]


def settings_changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return :func:`differences` of two training runs that learning so far depends on."""
    falls = any(flattened(now).get(name) is not None for name in FALLING)
    free = [name for name in FREE if not (falls and name in LENGTHS)]
    return [
        unlike
        for unlike in differences(before, now)
        if not any(unlike[0] == name or unlike[0].startswith(f"{name}.") for name in free)
    ]


def as_tensors(value: Any) -> Any:
    """Replace arrays in nested plain containers by tensors on the host, and NumPy scalars by Python numbers."""
    if isinstance(value, Mapping):
        return {name: as_tensors(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(as_tensors(item) for item in value)
    if isinstance(value, np.ndarray):
        # thousands of environments are gigabytes: not copied without need
        return torch.from_numpy(np.require(value, requirements=["C_CONTIGUOUS", "WRITEABLE"]))
    if isinstance(value, torch.Tensor):
        return value.cpu()
    return value.item() if isinstance(value, np.generic) else value


def as_arrays(value: Any) -> Any:
    """Replace tensors in nested plain containers by NumPy arrays, the inverse of :func:`as_tensors`."""
    if isinstance(value, Mapping):
        return {name: as_arrays(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(as_arrays(item) for item in value)
    return value.numpy() if isinstance(value, torch.Tensor) else value


def seed_all(seed: int) -> None:
    """Seed the global generators of Python, NumPy and torch."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def random_states() -> dict[str, Any]:
    """Return the states of the generators that :func:`seed_all` seeds."""
    kind, keys, position, has_gauss, gauss = np.random.get_state()
    return {
        "python": random.getstate(),
        "numpy": {"kind": kind, "keys": keys, "position": position, "has_gauss": has_gauss, "gauss": gauss},
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
    }


def set_random_states(states: Mapping[str, Any]) -> None:
    """Restore the generators to what :func:`random_states` returned."""
    random.setstate(states["python"])
    own = states["numpy"]
    np.random.set_state((own["kind"], own["keys"].numpy(), own["position"], own["has_gauss"], own["gauss"]))
    torch.set_rng_state(states["torch"])
    if states["cuda"]:
        torch.cuda.set_rng_state_all(states["cuda"])


class Diverged(ArithmeticError):
    """A training run with parameters or outputs that are not finite; the message is one line."""


def check_finite(
    modules: Mapping[str, torch.nn.Module],
    outputs: Mapping[str, torch.Tensor],
    steps: int,
    rate: tuple[str, float],
    checkpoint: Path | None = None,
) -> None:
    """Raise an error if a network's parameters or outputs are not finite.

    Args:
        modules: the networks, by name.
        outputs: what they make of what was observed last, by name.
        steps: of the environments, so far.
        rate: name and value of the learning rate's setting.
        checkpoint: of the training, if it has one.

    Raises:
        Diverged: a parameter or an output is not finite.
    """
    named = [(f"{name}.{own}", tensor) for name, part in modules.items() for own, tensor in part.named_parameters()]
    named += outputs.items()
    device = named[0][1].device  # outputs may be on the host, networks not
    # one answer of all, for which a GPU is waited for once
    if torch.stack([tensor.isfinite().all().to(device) for _, tensor in named]).all():
        return
    name, tensor = next((name, tensor) for name, tensor in named if not tensor.isfinite().all())
    place = (~tensor.isfinite()).nonzero()[0].tolist()
    kept = f"; {checkpoint} is left as it was before" if checkpoint is not None and checkpoint.exists() else ""
    setting, value = rate
    raise Diverged(
        f"the training has diverged: {name}{place or ''} is {tensor[tuple(place)].item()}, not finite, after {steps} "
        f"steps; begin anew in another folder (--out) with a smaller {setting}, now {value:g}{kept}"
    )
