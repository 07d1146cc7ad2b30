"""A training run of RLlib on two nodes of a local cluster, one of which is killed in the middle."""

from __future__ import annotations

import pytest

ray = pytest.importorskip("ray", reason="needs RLlib: make test-rllib")

from ray.cluster_utils import Cluster  # noqa: E402
from ray.rllib.algorithms.ppo import PPOConfig  # noqa: E402

from piavatar_envs.api.rllib import distinct_seeds  # noqa: E402

NODE = {"object_store_memory": 100 * 2**20, "include_dashboard": False}
STEPS = 96
PATIENCE = 40  # iterations until a restarted env runner plays again


@pytest.fixture
def nodes(monkeypatch_module):
    """A cluster of a head with one CPU; yields it and a function that adds a node of one CPU."""
    monkeypatch_module.setenv("RAY_USAGE_STATS_ENABLED", "0")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, **NODE})
    cluster.connect()
    yield cluster, lambda: cluster.add_node(num_cpus=1, **NODE)
    ray.shutdown()
    cluster.shutdown()


def places(algorithm) -> list[str]:
    """Return the node of every env runner that answers."""
    return algorithm.env_runner_group.foreach_env_runner(
        lambda _: ray.get_runtime_context().get_node_id(), local_env_runner=False
    )


def test_a_training_outlives_a_node(nodes):
    cluster, add_node = nodes
    second = add_node()
    cluster.wait_for_nodes()
    algorithm = (
        PPOConfig()
        .environment("piavatar_envs:PIAvatar/Reach-v0", env_config={"fidelity": "tiny", "episode_seconds": 0.4})
        .env_runners(num_env_runners=2, num_envs_per_env_runner=2, gym_env_vectorize_mode="vector_entry_point")
        .training(train_batch_size_per_learner=STEPS, minibatch_size=STEPS, num_epochs=1)
        .fault_tolerance(restart_failed_env_runners=True, env_runner_health_probe_timeout_s=5)
        .callbacks(on_environment_created=distinct_seeds)
        .debugging(seed=7)
        .build_algo()
    )
    iterations = 0

    def train() -> dict:
        nonlocal iterations
        result = algorithm.train()
        iterations += 1
        assert result["env_runners"]["num_env_steps_sampled"] == STEPS
        assert result["num_env_steps_sampled_lifetime"] == STEPS * iterations
        return result["fault_tolerance"]

    assert train()["num_healthy_workers"] == 2 and len(set(places(algorithm))) == 2
    cluster.remove_node(second, allow_graceful=False)
    # the env runner that is left plays all steps of an iteration
    states = [train() for _ in range(3)]
    assert states[-1]["num_healthy_workers"] == 1 and states[-1]["num_remote_worker_restarts"] == 0
    assert len(places(algorithm)) == 1
    add_node()
    states += [train()]
    while states[-1]["num_healthy_workers"] < 2 and iterations < PATIENCE:
        states += [train()]
    assert states[-1]["num_healthy_workers"] == 2 and states[-1]["num_remote_worker_restarts"] == 1
    assert len(set(places(algorithm))) == 2
    algorithm.stop()
