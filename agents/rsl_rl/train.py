"""PPO with rsl_rl on a batch of environments: ``python -m agents.rsl_rl.train configs/rsl_rl/reach_rsl.yaml``.

Writes to the folder: the resolved configuration, the networks, TensorBoard's files and rsl_rl's own saved networks, the
learning curve, and the evaluation. A killed run continues with ``--resume`` from the latest checkpoint, with the same
results as without the interruption. ``torchrun --nproc-per-node=2 -m agents.rsl_rl.train ...`` trains on two GPUs.
"""

from __future__ import annotations

import time
from collections import deque
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.utils.log_writer import LogWriter
from rsl_rl.utils.logger import Logger
from tensordict import TensorDict
from torch.utils.tensorboard import SummaryWriter

from agents.batch_training import Learned, iterations_of, run
from agents.checkpoint import Checkpoint, as_arrays, check_finite, random_states, seed_all, set_random_states
from agents.files import write_atomically, write_config
from agents.ranks import ALONE, Ranks
from agents.report import Curve
from agents.rsl_rl.curriculum import CURRICULA, CurriculumEnv, training_settings
from agents.rsl_rl.policy import RslTraining, actor_settings, mean_agent, network_settings
from agents.rsl_rl.ppo import Mirror, ScaledPPO
from agents.sb3.workers import components
from piavatar_envs.api.rsl_rl import AvatarRslEnv
from piavatar_envs.config import ConfigError
from piavatar_envs.envs.task import Task
from piavatar_envs.tasks import load_task


class CurveWriter(LogWriter):
    """Writer of rsl_rl's figures to TensorBoard, and of mean returns of 100 episodes to the curve."""

    def __init__(self, log_dir: str, steps_an_iteration: int, first_iteration: int, curve: Curve) -> None:
        """Open the files of a folder.

        Args:
            log_dir: for the files; those of the run's earlier parts stay.
            steps_an_iteration: of all environments.
            first_iteration: what was logged of this one and later ones, before the run was killed, is no longer shown.
            curve: so far.
        """
        self.curve, self.steps_an_iteration = curve, steps_an_iteration
        self._events = SummaryWriter(log_dir=log_dir, purge_step=first_iteration or None)

    def add_scalar(self, tag: str, scalar_value: Any, global_step: int) -> None:
        """Log a number of an iteration."""
        if tag.endswith("/time"):  # against seconds; TensorBoard does that by itself, and would purge it by iterations
            return
        self._events.add_scalar(tag, scalar_value, global_step)
        if tag == "Train/mean_reward":
            self.curve.steps.append(self.steps_an_iteration * (global_step + 1))
            self.curve.returns.append(float(scalar_value))

    def stop(self) -> None:
        """Close the file."""
        self._events.close()


class SilentWriter(LogWriter):
    """Writer of the ranks whose figures rank 0 writes."""

    def add_scalar(self, tag: str, scalar_value: Any, global_step: int) -> None:
        """Write nothing."""


class RanksLogger(Logger):
    """rsl_rl's logger, with figures of all ranks: each books its episodes, and rank 0 writes means over them."""

    def __init__(self, ranks: Ranks, *args: Any, **settings: Any) -> None:
        """Build the logger.

        Args:
            ranks: of the training.
            *args: those of the base.
            **settings: likewise.
        """
        super().__init__(*args, **settings)
        self.ranks = ranks
        self.git_status_repos.clear()  # results.json has the commit; no diffs of other repositories

    def init_logging_writer(self) -> None:
        """Open the files on rank 0."""
        if self.ranks.first:
            super().init_logging_writer()
        else:
            self.writer = SilentWriter()

    def log(self, *args: Any, **figures: Any) -> None:
        """Log an iteration on rank 0."""
        if self.ranks.size > 1:
            own = self.rewbuffer, self.lenbuffer
            parts = self.ranks.gather([list(self.rewbuffer), list(self.lenbuffer), self._means()])
            self.ep_extras = [means for _, _, means in parts]
            self.rewbuffer, self.lenbuffer = (deque(chain(*(part[index] for part in parts))) for index in (0, 1))
        if self.ranks.first:
            super().log(*args, **figures)
        if self.ranks.size > 1:
            self.rewbuffer, self.lenbuffer = own

    def _means(self) -> dict[str, float]:
        """Return the means over an iteration of what the environments have logged."""
        names = dict.fromkeys(name for logged in self.ep_extras for name in logged)
        return {
            name: torch.cat([torch.as_tensor(logged[name]).flatten() for logged in self.ep_extras if name in logged])
            .float()
            .mean()
            .item()
            for name in names
        }


class Runner(OnPolicyRunner):
    """rsl_rl's runner, which also saves a checkpoint and resumes from one.

    Attributes:
        curve: of the training.
        iterations: how many it has had.
    """

    def __init__(self, env: CurriculumEnv, config: RslTraining, folder: Path, checkpoint: Checkpoint) -> None:
        """Build networks and environments, and restore the checkpoint if there is one."""
        saved = checkpoint.state
        self.curve, self.iterations, self.checkpoint = Curve(), saved["iterations"] if saved else 0, checkpoint
        if saved:
            self.curve.load(saved["curve"])
        self._begun = time.monotonic() - self.curve.seconds
        self._ranks = checkpoint.ranks
        self._steps_an_iteration = self._ranks.size * config.num_envs * config.ppo.rollout_steps
        settings = runner_settings(config, env) | {
            "logger": {
                "class_name": CurveWriter,
                "steps_an_iteration": self._steps_an_iteration,
                "first_iteration": self.iterations,
                "curve": self.curve,
            }
        }
        super().__init__(env, settings, log_dir=str(folder / "rsl_rl"), device=str(env.device))
        self.alg.check, self.alg.learned = self._check_finite, self._end_if_asked
        self._config, self._folder = config, folder
        self.logger = RanksLogger(
            self._ranks,
            self.logger.log_dir,
            self.cfg,
            env.cfg,
            env.num_envs,
            self.is_distributed,
            self.gpu_world_size,
            self.gpu_global_rank,
            self.device,
        )
        config.seed_draws(self._ranks)
        if saved:
            self._restore(saved)

    def _configure_multi_gpu(self) -> None:
        """Take over the group that has been joined, in which ranks may also be CPUs; rsl_rl would start another."""
        ranks = self._ranks
        self.gpu_global_rank, self.gpu_local_rank, self.gpu_world_size = ranks.rank, ranks.local_rank, ranks.size
        self.is_distributed = ranks.size > 1
        group = {"global_rank": ranks.rank, "local_rank": ranks.local_rank, "world_size": ranks.size}
        self.cfg["multi_gpu"] = group if self.is_distributed else None

    def train(self, iterations: int) -> None:
        """Learn until the training has had ``iterations``.

        Raises:
            ConfigError: there have been more already.
            KeyboardInterrupt: Ctrl-C, after a checkpoint was written.
        """
        left = iterations - iterations_of(self.checkpoint, iterations)
        if left:
            self.current_learning_iteration = self.iterations
            with self.checkpoint.stop.listening():
                self.learn(left, init_at_random_ep_len=self.iterations == 0)

    def save(self, path: str, infos: dict | None = None) -> None:
        """Save the networks and the checkpoint; rsl_rl calls it between iterations, on all ranks."""
        self.iterations = self.current_learning_iteration + 1
        if self._ranks.first:
            super().save(path, infos)
            self.curve = self.logger.writer.curve
            if "motions" in self.env.curricula:
                table = self.env.curricula["motions"].table(self.env.host.task.motion_names)
                write_atomically(self._folder / "motions.csv", lambda file: file.write(table.encode()))
        self.curve.seconds = time.monotonic() - self._begun
        self.checkpoint.save(self._shared_state(), self._own_state())
        self.checkpoint.stop.obey(self.checkpoint.reached)

    def _end_if_asked(self) -> None:
        """Let an iteration that Ctrl-C has made the last one be saved."""
        if self.checkpoint.stop.asked():
            self.cfg["save_interval"] = 1

    def _check_finite(self) -> None:
        """Raise an error if networks have diverged, before anything is saved.

        Raises:
            Diverged: they have.
        """
        networks, config = {"actor": self.alg.actor, "critic": self.alg.critic}, self._config
        seen = self.env.get_observations()
        with torch.no_grad():
            outputs = {f"the {name}'s output": network(seen) for name, network in networks.items()}
        steps = self.alg.updates * self._steps_an_iteration
        check_finite(networks, outputs, steps, ("ppo.learning_rate", config.ppo.learning_rate), self.checkpoint.path)

    def _shared_state(self) -> dict[str, Any]:
        """Return what is the same on all ranks, or rank 0's to write."""
        return {
            "iterations": self.iterations,
            "algorithm": self.alg.save(),
            "logged": [self.logger.tot_timesteps, self.logger.tot_time],
            "curve": self.curve.state(),
        }

    def _own_state(self) -> dict[str, Any]:
        """Return what every rank has of its own."""
        log = self.logger
        return {
            "curricula": {name: curriculum.state() for name, curriculum in self.env.curricula.items()},
            "envs": self.env.host.get_state(),
            "returns": [list(log.rewbuffer), list(log.lenbuffer)],
            "playing": [log.cur_reward_sum, log.cur_episode_length],
            "random": random_states(),
        }

    def _restore(self, saved: dict[str, Any]) -> None:
        self.alg.load(saved["algorithm"], None, strict=True)  # the adapted learning rate is the optimizer's
        self.env.host.set_state(as_arrays(saved["envs"]))
        log = self.logger
        for own, latest in zip((log.rewbuffer, log.lenbuffer), saved["returns"], strict=True):
            own.extend(latest)
        for own, sums in zip((log.cur_reward_sum, log.cur_episode_length), saved["playing"], strict=True):
            own.copy_(sums)
        log.tot_timesteps, log.tot_time = saved["logged"]
        set_random_states(saved["random"])
        self.alg.updates = self.iterations
        self.env.steps = self.iterations * self.env.rollout_steps
        for name, curriculum in self.env.curricula.items():
            curriculum.load(saved["curricula"][name])


def runner_settings(config: RslTraining, env: AvatarRslEnv) -> dict[str, Any]:
    """Return the configuration as rsl_rl's runner takes it.

    Raises:
        ConfigError: steps cannot be mirrored.
    """
    ppo, sees = config.ppo, list(env.get_observations().keys())
    if ppo.mirrored and sees != ["policy"]:
        raise ConfigError("ppo.mirrored is for vectors, and the networks see pictures; leave it out")
    return {
        "num_steps_per_env": ppo.rollout_steps,
        "save_interval": config.checkpoint_every,
        "obs_groups": {"actor": sees, "critic": sees},
        "actor": actor_settings(ppo, sees),
        "critic": network_settings(ppo, sees),
        "algorithm": {
            "class_name": ScaledPPO,
            "reward_scale": ppo.reward_scale,
            "observation_noise": ppo.observation_noise,
            "kl_targets": kl_targets(config),
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.minibatches,
            "learning_rate": ppo.learning_rate,
            "schedule": "fixed" if ppo.desired_kl is None else "adaptive",
            "desired_kl": ppo.desired_kl,
            "gamma": ppo.discount,
            "lam": ppo.gae_lambda,
            "clip_param": ppo.clip_range,
            "value_loss_coef": ppo.value_weight,
            "entropy_coef": ppo.entropy_weight,
            "max_grad_norm": ppo.largest_gradient,
            "symmetry_cfg": _symmetry(env) if ppo.mirrored else None,
        },
    }


def kl_targets(config: RslTraining) -> list[float]:
    """Return the target divergences of the updates; empty where the target is fixed.

    Raises:
        ConfigError: there is a last one without a first one.
    """
    first, last = config.ppo.desired_kl, config.ppo.final_kl
    if last is None:
        return []
    if first is None:
        raise ConfigError(f"ppo.final_kl={last} is what ppo.desired_kl falls to, and there is none; give both")
    return np.linspace(first, last, config.iterations).tolist()


def _symmetry(env: AvatarRslEnv) -> dict[str, Any]:
    """Return the settings by which rsl_rl appends reflected steps to every minibatch."""
    terms = [env.observation_layout[name] for name in env.groups["policy"]]
    spec = env.host.groups[0].action_spec
    mirror = Mirror(terms, spec.joints, env.device, spec.root)

    def append(
        env: AvatarRslEnv, obs: TensorDict | None = None, actions: torch.Tensor | None = None
    ) -> tuple[TensorDict | None, torch.Tensor | None]:
        if obs is not None:
            obs = torch.cat([obs, obs.apply(mirror.observations)])
        return obs, None if actions is None else torch.cat([actions, mirror.actions(actions)])

    return {"data_augmentation_func": append, "use_data_augmentation": True}


def make_env(config: RslTraining, task: Task, device: str, ranks: Ranks = ALONE) -> CurriculumEnv:
    """Build the training environments of a rank.

    Raises:
        ConfigError: there is no such term to observe, an assist under pose control, or a curriculum that does not fit.
    """
    settings = training_settings(task, config.curriculum)
    if config.assist is not None and settings.control.mode == "pose":
        raise ConfigError('assist is for bodies under torques, and env.control.mode="pose"; use "pd" or "torque"')
    if config.assist is not None and settings.control.root_assist > 0.0:
        raise ConfigError(
            f"assist declines to 0, and env.control.root_assist={settings.control.root_assist} stays; give one of them"
        )
    groups = None if config.observe is None else {"policy": config.observe}
    about = (config.env_id, config.num_envs, device, settings, groups, config.first_seed_on(ranks), ranks.threads)
    given = {name: getattr(config, name) for name in CURRICULA}
    schedules = {name: settings for name, settings in given.items() if settings is not None}
    return CurriculumEnv(schedules, config.ppo.rollout_steps, *about, ranks=ranks)


def learn(config: RslTraining, task: Task, folder: Path, device: str, checkpoint: Checkpoint) -> Learned:
    """Train an agent; to be called on all ranks.

    Args:
        config: resolved.
        task: of the environments.
        folder: where rank 0 writes; exists.
        device: where to simulate and to learn.
        checkpoint: from which to go on, and which to keep up.

    Raises:
        ConfigError: the configuration does not fit the environment, or the checkpoint has had more iterations.
        Diverged: the networks are not finite any more.
    """
    ranks = checkpoint.ranks
    with ranks.leaders_first():
        env = make_env(config, task, device, ranks)
    seed_all(config.seed)
    runner = Runner(env, config, folder, checkpoint)
    if ranks.first:
        write_config(folder, config)
    runner.train(config.iterations)
    runner.curve.train_steps = ranks.size * config.iterations * config.num_envs * config.ppo.rollout_steps
    actor = runner.get_inference_policy(str(env.device))
    if ranks.first:
        write_atomically(folder / "policy.pt", lambda file: torch.save(actor.state_dict(), file))
    env.close()
    return Learned(mean_agent(actor, components(env.observation_layout, config.observe), str(env.device)), runner.curve)


def main(args: list[str] | None = None) -> None:
    """Run the command line."""
    run("rsl_rl.train", RslTraining, load_task, learn, args)


if __name__ == "__main__":
    main()
