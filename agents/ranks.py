"""Ranks: the processes of one training run that ``torchrun`` starts, each with a batch of environments of its own.

``torchrun --nproc-per-node=2 -m agents.rsl_rl.train ...`` starts two. With ``--device cuda`` each takes the GPU of its
local rank, and gradients are summed by NCCL; on a CPU, or where all share the one GPU of ``--device cuda:0``, by Gloo.
The learning libraries reduce gradients and normalisers themselves; here are the group, what a script has to agree on,
and the end: when one rank fails, all end with its message.

Figures, folders and checkpoints are rank 0's alone, so that other machines need none of its files.
"""

from __future__ import annotations

import io
import os
import secrets
import signal
import socket
import threading
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
from torch import distributed

from piavatar_envs.config import ConfigError
from piavatar_envs.core.launch_graph import available_cores
from piavatar_envs.core.reading import first_line

#: Of a value that is sent from rank to rank, at once [B].
_PART = 2**28
#: Between two heartbeats of a rank, and how many may be missed [s, -].
_POLL, _MISSED = 1.0, 40
#: In which torchrun's store has to reply, which it keeps before it starts a rank, and in which all have to start [s].
_CONNECT = 120.0
_JOIN = 600.0
#: That a rank waits, once another on its machine has failed, for torchrun to end it [s].
_GRACE = 10.0


@dataclass(frozen=True)
class Ranks:
    """Place of this process among those of a training run; by default it is the only one.

    Attributes:
        rank: from 0 to ``size - 1``.
        size: number of processes, over all machines.
        local_rank: among those of this machine.
        local_size: number of those.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1

    @classmethod
    def here(cls, environment: Mapping[str, str] = os.environ) -> Ranks:
        """Read the place that torchrun has set in the environment's variables."""
        names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
        if int(environment.get("WORLD_SIZE", "1")) == 1:
            return cls()
        return cls(*(int(environment[name]) for name in names))

    @property
    def first(self) -> bool:
        """Whether this rank logs, saves and evaluates."""
        return self.rank == 0

    @property
    def threads(self) -> int | None:
        """Threads of a batch on a CPU: the cores of the machine are shared; None for all."""
        return None if self.size == 1 else max(1, available_cores() // self.local_size)

    def device(self, asked: str) -> str:
        """Return the device of this rank: for ``"cuda"`` the GPU of its local rank, else what was asked for.

        Raises:
            ConfigError: there are fewer GPUs than ranks.
        """
        if self.size == 1 or asked != "cuda":
            return asked
        if (found := torch.cuda.device_count()) < self.local_size:
            raise ConfigError(
                f"{self.local_size} ranks on a machine with {found} GPUs; start --nproc-per-node={max(found, 1)}, or "
                "let all share one with --device cuda:0"
            )
        return f"cuda:{self.local_rank}"

    def any(self, flag: bool) -> bool:
        """Return whether the flag of any rank is set; to be called on all of them, as what follows here."""
        return -self.least(-int(flag)) > 0

    def least(self, number: int) -> int:
        """Return the smallest of the ranks' numbers."""
        if self.size == 1:
            return number
        least = torch.tensor(number)
        distributed.all_reduce(least, op=distributed.ReduceOp.MIN)
        return int(least)

    @contextmanager
    def leaders_first(self) -> Iterator[None]:
        """Let the first rank of every machine go ahead: it fills the caches of kernels and bodies for the others."""
        if self.local_rank:
            self.any(False)
        yield
        if not self.local_rank:
            self.any(False)

    def add(self, values: torch.Tensor) -> torch.Tensor:
        """Sum a tensor over the ranks, in place."""
        if self.size > 1:
            distributed.all_reduce(values)
        return values

    def gather(self, value: Any) -> list[Any]:
        """Return the values of all ranks on rank 0, in their order, and nothing on the others.

        One after the other is received, because the states of thousands of environments are gigabytes.

        Args:
            value: what a checkpoint may hold: nested containers of tensors on the host and plain values.
        """
        if self.first:
            return [value, *(_receive(rank) for rank in range(1, self.size))]
        _send(value, 0)
        return []

    def scatter(self, values: Sequence[Any]) -> Any:
        """Return this rank's of the values that rank 0 has, one for each; the inverse of :meth:`gather`."""
        if not self.first:
            return _receive(0)
        for rank in range(1, self.size):
            _send(values[rank], rank)
        return values[0]


def _send(value: Any, rank: int) -> None:
    """Send a value to another rank, as a file of torch."""
    file = io.BytesIO()
    torch.save(value, file)
    content = torch.frombuffer(file.getbuffer(), dtype=torch.uint8)
    distributed.send(torch.tensor(len(content)), rank)
    for part in content.split(_PART):
        distributed.send(part, rank)


def _receive(rank: int) -> Any:
    """Receive what another rank sends, without running code that it might contain."""
    size = torch.tensor(0)
    distributed.recv(size, rank)
    content = torch.empty(int(size), dtype=torch.uint8)
    for part in content.split(_PART):
        distributed.recv(part, rank)
    return torch.load(io.BytesIO(content.numpy()), weights_only=True)


#: A training run in one process.
ALONE = Ranks()


@contextmanager
def joined(ranks: Ranks, asked: str) -> Iterator[str]:
    """Join the group of a training run's processes for the duration, with the device of this rank; all end it together.

    An error on one rank ends the others, too, with its message: torchrun ends those on the same machine, and on other
    machines a thread reads the message from torchrun's store. A rank without a heartbeat for 40 seconds counts as
    failed.

    Args:
        ranks: of which this is one; alone, it does nothing.
        asked: for the device, see :meth:`Ranks.device`.

    Raises:
        SystemExit: an error, which has been printed; alone, it is passed on.
    """
    if ranks.size == 1:
        yield asked
        return
    store = next(distributed.rendezvous("env://", timeout=timedelta(seconds=_CONNECT)))[0]
    store = distributed.PrefixStore(_fresh_name(store, ranks), store)
    watch = _Watch(distributed.PrefixStore("watch", store.clone()), ranks)
    watch.start()
    try:
        device = ranks.device(asked)
        if device != "cpu":
            torch.cuda.set_device(torch.device(device))
        backend = "cpu:gloo,cuda:nccl" if asked == "cuda" else "gloo"
        distributed.init_process_group(backend, store=store, rank=ranks.rank, world_size=ranks.size)
        yield device
        watch.finish()
    except Exception as error:
        watch.fail(error)
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        if ranks.first:
            raise
        raise SystemExit(128 + signal.SIGINT) from None  # rank 0 has a line for it
    finally:
        watch.stop()
    distributed.destroy_process_group()


def _fresh_name(store: distributed.Store, ranks: Ranks) -> str:
    """Agree on a name that no earlier group has had.

    torchrun's store outlives the processes that it starts again, and what it still holds of them would be taken for
    the new ones'. Numbers of restarts differ between machines, so rank 0 replies to a random number of each rank.

    Raises:
        RuntimeError: some ranks are missing.
    """
    own, deadline = secrets.token_hex(8), time.monotonic() + _JOIN
    missing = {ranks.rank} if ranks.rank else set(range(1, ranks.size))
    if ranks.rank:
        store.set(f"nonce_{ranks.rank}", own)
    while True:
        for rank in tuple(missing):
            if ranks.rank:
                to, _, name = _read(store, f"reply_{rank}").partition(" ")
                if to == own:
                    store.set(f"accepted_{rank}", name)
                    return name
            elif _read(store, f"accepted_{rank}") == own:
                missing.remove(rank)
            elif nonce := _read(store, f"nonce_{rank}"):
                store.set(f"reply_{rank}", f"{nonce} {own}")
        if not missing:
            return own
        if time.monotonic() > deadline:
            raise RuntimeError(f"not all of the {ranks.size} ranks have started within {_JOIN:.0f} s")
        time.sleep(0.05)


def _read(store: distributed.Store, key: str) -> str:
    """Return what a store holds, or an empty string."""
    return store.get(key).decode() if store.check([key]) else ""


class _Watch:
    """Thread of a rank that writes heartbeats to torchrun's store, and ends the process when another has failed."""

    def __init__(self, store: distributed.Store, ranks: Ranks) -> None:
        """Write the first heartbeat; :meth:`start` begins the watch."""
        self._store, self._ranks, self._over = store, ranks, threading.Event()
        self._watched = range(1, ranks.size) if ranks.first else range(1)
        self._missed = dict.fromkeys(self._watched, 0)
        self._latest: dict[int, str] = {}
        self._machine = os.environ.get("GROUP_RANK", "0")
        self._beats = 0
        self._beat()
        self._thread = threading.Thread(target=self._watch, name="ranks", daemon=True)

    def start(self) -> None:
        """Begin the watch."""
        self._thread.start()

    def stop(self) -> None:
        """End the watch."""
        self._over.set()
        self._thread.join()

    def finish(self) -> None:
        """Wait until all ranks are here; rank 0 comes last, from the evaluation."""
        own = self._store.clone()
        if self._ranks.first:
            own.set("over", "")
        while not own.check(["over"]):
            time.sleep(0.1)
        self._ranks.any(False)

    def fail(self, error: Exception) -> None:
        """Print what has ended this rank and report it, unless it is that another one has ended before."""
        self.stop()
        if self._store.check(["failed"]):
            return
        expected = isinstance(error, (ConfigError, ArithmeticError, OSError))
        message = str(error) if expected else first_line(error)
        printed = f"error: {message}\n" if expected else "".join(traceback.format_exception(error))
        os.write(2, printed.encode())
        where = f"rank {self._ranks.rank} on {socket.gethostname()}"
        self._store.set("failed", f"{self._machine}\n{where}: {message}")
        time.sleep(3.0 * _POLL)  # torchrun's store may end with this process, and the others read it every _POLL

    def _watch(self) -> None:
        report = ""
        try:
            while not report and not self._over.wait(_POLL):
                self._beat()
                self._check_others()
                if self._store.check(["failed"]):
                    report = self._store.get("failed").decode()
        except RuntimeError as error:  # torch's, of a store that does not answer
            report = f"\nrank {self._ranks.rank} has lost torchrun's store: {first_line(error)}"
        if report and not self._over.is_set():
            self._end(report)

    def _beat(self) -> None:
        self._beats += 1
        self._store.set(f"beats_{self._ranks.rank}", str(self._beats))

    def _check_others(self) -> None:
        """Report a rank without a heartbeat; rank 0 watches all, and all watch rank 0."""
        for rank in self._watched:
            beats = _read(self._store, f"beats_{rank}")
            self._missed[rank] = 0 if self._latest.get(rank) != beats else self._missed[rank] + 1
            self._latest[rank] = beats
            if self._missed[rank] >= _MISSED and not self._store.check(["failed"]):
                self._store.set("failed", f"\nrank {rank} has had no heartbeat for {_MISSED * _POLL:.0f} s")

    def _end(self, report: str) -> None:
        """End this process; on the machine of a failed rank, its own message has been printed, and torchrun comes."""
        machine, _, message = report.partition("\n")
        if machine != self._machine:
            os.write(2, f"error: {message}\n".encode())
        elif self._over.wait(_GRACE):
            return
        os._exit(1)
