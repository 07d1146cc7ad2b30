"""PPO with RLlib, on one machine or several: ``python -m agents.rllib.train configs/rllib/reach_rllib.yaml``.

Starts Ray on this machine, or joins the cluster that ``RAY_ADDRESS`` names. A lost machine does not end the training:
env runners that are left play all steps, and lost ones are restarted where there are CPUs for them. Leaves in the
folder: the resolved configuration, the policies, a checkpoint, the learning curve, ``progress.csv`` with the env
runners at work and the restarts of every iteration, and the evaluation. ``--resume`` restores networks and optimizers;
the episodes begin anew.

Ray takes seconds to import, so command lines are read and refused before.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from agents.batch_training import Learned, iterations_of, run
from agents.checkpoint import Checkpoint, as_arrays, check_finite, seed_all
from agents.files import write_atomically, write_config
from agents.ranks import Ranks
from agents.report import Curve
from agents.rllib.envs import make_batch, make_game
from agents.rllib.policy import RLlibTraining, actors, find_task, mean_agent
from agents.sb3.workers import components
from piavatar_envs.api.host import EpisodeHost
from piavatar_envs.api.rllib import distinct_seeds
from piavatar_envs.config import ConfigError
from piavatar_envs.envs.task import Task

if TYPE_CHECKING:
    from ray.rllib.algorithms import Algorithm, AlgorithmConfig

#: Name of the policy that agents share.
SHARED = "shared"
#: Memory of Ray's object store where this script starts it [bytes].
_STORE = 200 * 2**20
#: Seconds within which an env runner says that it is alive, and a lost one comes back, before an iteration goes on.
_PROBE, _RESTORE = 10.0, 60.0


def algorithm_config(config: RLlibTraining, task: Task, device: str) -> AlgorithmConfig:
    """Return the configuration as RLlib takes it.

    Args:
        config: resolved.
        task: of the environments.
        device: where to simulate; networks learn on the CPU.
    """
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.tune.registry import register_env

    ppo, several = config.ppo, len(task.agent_names) > 1
    env = {"env_id": config.env_id, "env": dict(config.env), "observe": config.observe, "device": device}
    if not several and config.env_runners:
        env["num_threads"] = 1  # env runners have a CPU each
    register_env("piavatar", make_game if several else make_batch)
    batch = config.total_envs * ppo.rollout_steps
    algorithm = (
        PPOConfig()
        .environment("piavatar", env_config=env)
        .env_runners(
            num_env_runners=config.env_runners,
            num_envs_per_env_runner=config.num_envs,
            gym_env_vectorize_mode="sync" if several else "vector_entry_point",
            rollout_fragment_length=ppo.rollout_steps,
            num_gpus_per_env_runner=int(device != "cpu" and config.env_runners > 0),
        )
        .training(
            train_batch_size_per_learner=batch,
            minibatch_size=batch // ppo.minibatches,
            num_epochs=ppo.epochs,
            lr=ppo.learning_rate,
            gamma=ppo.discount,
            lambda_=ppo.gae_lambda,
            clip_param=ppo.clip_range,
            vf_clip_param=float("inf"),
            vf_loss_coeff=ppo.value_weight,
            entropy_coeff=ppo.entropy_weight,
            use_kl_loss=False,
            grad_clip=ppo.largest_gradient,
            grad_clip_by="global_norm",
        )
        .rl_module(
            model_config=DefaultModelConfig(
                fcnet_hiddens=list(ppo.hidden), fcnet_activation="tanh", vf_share_layers=False, free_log_std=True
            )
        )
        .fault_tolerance(
            restart_failed_env_runners=True,
            env_runner_health_probe_timeout_s=_PROBE,
            env_runner_restore_timeout_s=_RESTORE,
        )
        .callbacks(on_environment_created=distinct_seeds)
        .debugging(seed=config.first_seed, log_level="ERROR")
    )
    if several and config.policies == "shared":
        algorithm = algorithm.multi_agent(policies={SHARED}, policy_mapping_fn=lambda agent, episode, **_: SHARED)
    elif several:
        names = set(task.agent_names)
        algorithm = algorithm.multi_agent(policies=names, policy_mapping_fn=lambda agent, episode, **_: agent)
    return algorithm


def start_ray(config: RLlibTraining) -> None:
    """Join the cluster of ``RAY_ADDRESS``, or start Ray on this machine.

    Raises:
        ConfigError: there is no such cluster, RLlib is not installed, or torchrun has started this process.
    """
    if (size := Ranks.here().size) > 1:
        raise ConfigError(f"torchrun has started {size} processes; start one, which has env_runners instead")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise ConfigError('RLlib is not installed; install it with: pip install "ray[rllib]"') from None
    quiet = {"log_to_driver": False, "logging_level": "error", "ignore_reinit_error": True}
    if address := os.environ.get("RAY_ADDRESS"):
        try:
            ray.init(**quiet)
        except ConnectionError as error:
            raise ConfigError(
                f"RAY_ADDRESS={address} cannot be reached ({error}); start Ray there, or unset it"
            ) from None
    else:
        ray.init(num_cpus=config.env_runners + 1, include_dashboard=False, object_store_memory=_STORE, **quiet)
    logging.getLogger("ray").setLevel(logging.ERROR)


class Trainer:
    """A training run: RLlib's algorithm, its checkpoint and its curve.

    Attributes:
        algorithm: RLlib's.
        curve: of the training.
        iterations: how many it has had.
    """

    def __init__(self, config: RLlibTraining, task: Task, folder: Path, device: str, checkpoint: Checkpoint) -> None:
        """Build networks and env runners, and restore the checkpoint if there is one."""
        self.config, self.folder, self.checkpoint = config, folder, checkpoint
        self.agents, self.curve, self.iterations = len(task.agent_names), Curve(), 0
        self._progress = ["iteration,steps,seconds,return,env_runners,restarts"]
        seed_all(config.seed)
        self.algorithm: Algorithm = algorithm_config(config, task, device).build_algo()
        if saved := checkpoint.state:
            self.iterations, self._progress = saved["iterations"], list(saved["progress"])
            self.curve.load(saved["curve"])
            self.algorithm.learner_group.set_state({"learner": as_arrays(saved["learner"])})
        else:
            self.algorithm.learner_group.set_weights(first_weights(self.weights(), config.ppo.log_std))
        self.algorithm.env_runner_group.sync_weights(from_worker_or_learner_group=self.algorithm.learner_group)
        self._begun = time.monotonic() - self.curve.seconds

    def weights(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the parameters by policy."""
        return self.algorithm.learner_group.get_weights()

    def train(self) -> None:
        """Learn until the training has had all its iterations.

        Raises:
            Diverged: the networks are not finite any more.
            KeyboardInterrupt: Ctrl-C, after a checkpoint was written.
        """
        config, stop = self.config, self.checkpoint.stop
        with stop.listening():
            while self.iterations < config.iterations:
                result = self.algorithm.train()
                self.iterations += 1
                self._book(result)
                ends = self.iterations == config.iterations or stop.made
                if ends or self.iterations % config.checkpoint_every == 0:
                    self._save()
                stop.obey(self.checkpoint.reached)

    def _book(self, result: Mapping[str, Any]) -> None:
        """Add an iteration to the curve and to ``progress.csv``.

        Raises:
            Diverged: the networks are not finite any more.
        """
        steps = self.iterations * self.config.total_envs * self.config.ppo.rollout_steps
        rate = "ppo.learning_rate", self.config.ppo.learning_rate
        check_finite(actors(self.weights()), {}, steps, rate, self.checkpoint.path)
        faults = result["fault_tolerance"]
        mean = result["env_runners"].get("episode_return_mean", np.nan) / self.agents
        if np.isfinite(mean):  # some episode has ended
            self.curve.steps.append(steps)
            self.curve.returns.append(float(mean))
        self.curve.seconds = time.monotonic() - self._begun
        at_work = f"{int(faults['num_healthy_workers'])},{int(faults['num_remote_worker_restarts'])}"
        row = f"{self.iterations},{steps},{self.curve.seconds:.1f},{mean:.6g},{at_work}"
        self._progress.append(row)
        text = "\n".join(self._progress) + "\n"
        write_atomically(self.folder / "progress.csv", lambda file: file.write(text.encode()))

    def _save(self) -> None:
        learner = self.algorithm.learner_group.get_state(components=["learner"])["learner"]
        self.checkpoint.save(
            {
                "iterations": self.iterations,
                "learner": {name: learner[name] for name in ("rl_module", "optimizer")},
                "curve": self.curve.state(),
                "progress": self._progress,
            }
        )


def first_weights(weights: Mapping[str, Mapping[str, Any]], log_std: float) -> dict[str, dict[str, np.ndarray]]:
    """Return weights of policies whose first mean actions are near zero, and whose spread is as configured."""
    begun = {}
    for name, own in weights.items():
        begun[name] = {key: np.array(value) for key, value in own.items()}
        begun[name]["pi.log_std"] = np.full_like(begun[name]["pi.log_std"], log_std)
        for part in ("weight", "bias"):
            begun[name][f"pi.net.mlp.0.{part}"] = 0.01 * begun[name][f"pi.net.mlp.0.{part}"]
    return begun


def learn(config: RLlibTraining, task: Task, folder: Path, device: str, checkpoint: Checkpoint) -> Learned:
    """Train the policies.

    Args:
        config: resolved.
        task: of the environments.
        folder: where to write; exists.
        device: where to simulate.
        checkpoint: from which to go on, and which to keep up.

    Raises:
        ConfigError: an unknown term to observe, a checkpoint with more iterations than are configured, or no cluster.
        Diverged: the networks are not finite any more.
    """
    iterations_of(checkpoint, config.iterations)
    facts = EpisodeHost(task, 1, device)
    seen = components(facts.layout, config.observe)
    facts.close()
    start_ray(config)
    write_config(folder, config)
    trainer = Trainer(config, task, folder, device, checkpoint)
    trainer.train()
    trainer.curve.train_steps = config.iterations * config.total_envs * config.ppo.rollout_steps
    networks = actors(trainer.weights())
    states = {name: network.state_dict() for name, network in networks.items()}
    write_atomically(folder / "policy.pt", lambda file: torch.save(states, file))
    trainer.algorithm.stop()
    return Learned(mean_agent(networks, task.agent_names, seen), trainer.curve)


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    run("rllib.train", RLlibTraining, find_task, learn, args)


if __name__ == "__main__":
    main()
