"""Ray for the tests of this folder, which `make test-rllib` runs with the versions of requirements.txt."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def local_ray(monkeypatch_module):
    """Ray on this machine, with two CPUs and little memory."""
    import ray

    monkeypatch_module.setenv("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(num_cpus=2, include_dashboard=False, object_store_memory=100 * 2**20, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture(scope="module")
def monkeypatch_module():
    with pytest.MonkeyPatch.context() as patch:
        yield patch
