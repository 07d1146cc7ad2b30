"""Options and fixtures of the whole suite."""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

#: Environments that differ in kind: poses under a root wrench with props; torques and nothing that holds the root.
SAMPLE = ("PIAvatar/KickBall-v0", "PIAvatar/Stand-v0")


def reward_terms(info: dict) -> dict:
    """Return the terms of the reward in an info, by name."""
    return {name.removeprefix("reward_"): value for name, value in info.items() if name.startswith("reward_")}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test with ``env_id`` on every registered environment, one with ``sample_id`` on those of ``SAMPLE``.

    A test of a task's own code takes ``env_id``; of code that all tasks share, ``sample_id`` or a fixed id.
    """
    if "env_id" in metafunc.fixturenames:
        from piavatar_envs.tasks import task_modules

        metafunc.parametrize("env_id", list(task_modules()))
    if "sample_id" in metafunc.fixturenames:
        metafunc.parametrize("sample_id", SAMPLE)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--device",
        default="cpu",
        help="Warp device to test on: cpu (default), cuda, cuda:1, ..., or gpu_on_cpu: GPU kernels on the CPU",
    )
    parser.addoption(
        "--no-skips", action="store_true", help="fail where a test is skipped, as all it needs is installed"
    )


def pytest_collection() -> None:
    """Import everything without collections of garbage, which would visit each of its million objects."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Exempt what is imported from the collections that follow."""
    gc.enable()
    gc.freeze()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a run that skips what it was asked for."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if session.config.getoption("--no-skips") and reporter is not None and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@contextmanager
def only_one_process(name: str) -> Iterator[None]:
    """Hold a lock among the test workers of this user; without file locks (Windows), go on without."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with (Path(tempfile.gettempdir()) / f"piavatar-envs-{name}-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """The Warp device under test, its kernels compiled; those of ``gpu_on_cpu`` are compiled as they are launched.

    Parallel workers would all compile the same kernels at once, and race each other's files: the first one does it,
    the others wait and find them in the cache.
    """
    from piavatar_envs import doctor
    from tests import gpu_on_cpu

    name = request.config.getoption("--device")
    if name == gpu_on_cpu.NAME:
        with gpu_on_cpu.gpu_on_cpu():
            yield name
        return
    available = [entry["alias"] for entry in doctor.devices()]
    if name not in available and not (name == "cuda" and "cuda:0" in available):
        pytest.exit(f"--device {name}: this machine has {', '.join(available)}", returncode=4)
    with only_one_process("kernels"):
        try:
            doctor.compile_kernels(name, environments=False)
        except Exception as error:  # a kernel that does not compile fails its own tests, not all that use a device
            warnings.warn(f"not every kernel compiles for {name}: {error}", stacklevel=1)
    gc.freeze()  # the kernels' syntax trees, too
    yield name


@pytest.fixture(autouse=True)
def restored_registries() -> Iterator[None]:
    """Unregister the garments and fabrics of a test after it, which messages of others would list."""
    names = ("piavatar_envs.cloth.garments", "piavatar_envs.cloth.fabric")
    before = {name: dict(sys.modules[name]._registered) for name in names if name in sys.modules}
    yield
    for name in names:
        if name in sys.modules:
            registered = sys.modules[name]._registered
            registered.clear()
            registered.update(before.get(name, {}))


@contextmanager
def in_core_seconds(most: float) -> Iterator[None]:
    """Check that the body takes less time of a core than ``most`` [s], whatever other tests hold in memory."""
    gc.collect()
    gc.freeze()  # for good: to unfreeze would undo what collection has frozen
    begin = time.process_time()
    yield
    assert time.process_time() - begin < most


@pytest.fixture
def empty_kernel_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make an empty folder the cache of Warp, and of results kept beside its kernels; return the folder."""
    import warp as wp

    from piavatar_envs.core.kernel_cache import init_warp

    init_warp()  # or the folder restored after this test would be None, as it is before Warp is initialised
    folder = tmp_path / "kernel_cache"
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(folder))
    return folder


@pytest.fixture(scope="session")
def make_env(device: str):
    """A maker of single environments without wrappers, ``make_env(env_id, **settings)``, tiny by default.

    The same settings give the same object, because building takes longer than a test: begin with a reset. ``twin=1``
    gives another one of the same settings.
    """
    import gymnasium

    made: dict[tuple, gymnasium.Env] = {}

    def make(env_id: str, twin: int = 0, **settings):
        key = (env_id, twin, repr(sorted(settings.items())))
        if key not in made:
            made[key] = gymnasium.make(env_id, device=device, **{"fidelity": "tiny", **settings}).unwrapped
        return made[key]

    yield make
    for env in made.values():
        env.close()


@pytest.fixture(scope="session")
def make_batch(device: str):
    """A maker of batches, ``make_batch(env_id, num_envs, **settings)``; the same settings give the same object."""
    from piavatar_envs.config import load_config
    from piavatar_envs.envs.batch_env import BatchEnv
    from piavatar_envs.tasks import load_task

    made: dict[tuple, BatchEnv] = {}

    def make(env_id: str, num_envs: int = 1, **settings) -> BatchEnv:
        key = (env_id, num_envs, repr(sorted(settings.items())))
        if key not in made:
            task = load_task(env_id)
            config = load_config(task.Config, None, {"fidelity": "tiny", **settings})
            made[key] = BatchEnv(task(config), num_envs, device)
        return made[key]

    return make


@pytest.fixture(scope="session")
def equal():
    """Comparison of two runs that should be the same: bit for bit, on a GPU too."""

    def compare(a, b) -> bool:
        a, b = np.asarray(a), np.asarray(b)
        return a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()

    return compare
