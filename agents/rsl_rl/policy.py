"""Policies of rsl_rl's PPO: the settings of their trainings, their networks, and agents out of files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, Field
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict

from agents.batch_training import BatchTraining, load_batched
from agents.checkpoint import load_weights, policy_mismatch, read_checkpoint
from agents.config import Widths
from agents.evaluate import Agent
from agents.files import CHECKPOINT
from agents.rsl_rl.curriculum import AssistSchedule, MotionSchedule
from agents.sb3.workers import components
from piavatar_envs.config import FROZEN, FrozenDict
from piavatar_envs.core.reading import UNREADABLE
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.tasks import load_task


class RslPPOSettings(BaseModel):
    """Hyper-parameters of rsl_rl's PPO."""

    model_config = FROZEN

    rollout_steps: int = Field(32, ge=2, description="steps of every environment between two updates")
    epochs: int = Field(8, ge=1, description="passes over a rollout")
    minibatches: int = Field(4, ge=1, description="minibatches in a pass")
    learning_rate: float = Field(7.0e-4, gt=0.0, description="Adam's first learning rate [-]")
    desired_kl: float | None = Field(
        0.01, gt=0.0, description="divergence of an update to which the learning rate adapts [-]; null for a fixed rate"
    )
    final_kl: float | None = Field(
        None, gt=0.0, description="what desired_kl falls to by the last update, in even steps; null for no change [-]"
    )
    discount: float = Field(0.9, gt=0.0, le=1.0, description="discount of a step's reward, gamma [-]")
    reward_scale: float = Field(
        1.0,
        gt=0.0,
        description="factor on what the networks see of a reward [-]; the critic follows by clip_range a step, so "
        "discounted returns should be about 1",
    )
    gae_lambda: float = Field(0.8, ge=0.0, le=1.0, description="bias against variance of the advantage [-]")
    clip_range: float = Field(0.2, gt=0.0, description="largest change of an action's probability ratio [-]")
    value_weight: float = Field(1.0, ge=0.0, description="weight of the critic's squared error [-]")
    entropy_weight: float = Field(0.0, ge=0.0, description="weight of the entropy bonus [-]")
    largest_gradient: float = Field(1.0, gt=0.0, description="norm to which gradients are clipped [-]")
    action_std: float = Field(0.6, gt=0.0, description="standard deviation of the first actions [-]")
    normalize_observation: bool = Field(False, description="whether networks see observations by running statistics")
    observation_noise: float = Field(
        0.0,
        ge=0.0,
        description="standard deviation of noise on what networks see while they learn, in the terms' own units; what "
        "hardly moves then, such as a joint that is held, is not taken for exact",
    )
    mirrored: bool = Field(False, description="whether it also learns from every step as it is in a mirror")
    hidden: Widths = Field((128, 128), min_length=1, description="widths of the hidden layers of both networks")


class RslTraining(BatchTraining):
    """Settings of a training with rsl_rl."""

    env_id: str = Field("PIAvatar/Reach-v0", description="registered id")
    ppo: RslPPOSettings = Field(default_factory=RslPPOSettings, description="the algorithm")
    assist: AssistSchedule | None = Field(
        None, description="schedule of root_assist while it learns; null for the environment's own"
    )
    motions: MotionSchedule | None = Field(
        None, description="weights by which episodes draw their motions while it learns; null to draw all alike"
    )
    curriculum: Annotated[dict[str, Any], AfterValidator(FrozenDict)] = Field(
        default_factory=dict, description="settings of the environment that differ from env while it learns"
    )


def load_rsl(
    source: Mapping[str, Any] | str | Path | None = None, overrides: Mapping[str, Any] | None = None
) -> RslTraining:
    """Load a configuration; arguments and errors are those of :func:`agents.batch_training.load_batched`."""
    return load_batched(RslTraining, load_task, source, overrides)


def network_settings(ppo: RslPPOSettings) -> dict[str, Any]:
    """Return the settings of a network as rsl_rl takes them."""
    return {
        "class_name": "MLPModel",
        "hidden_dims": list(ppo.hidden),
        "activation": "tanh",
        "obs_normalization": ppo.normalize_observation,
    }


def actor_settings(ppo: RslPPOSettings) -> dict[str, Any]:
    """Return the settings of the actor, whose outputs are means of a Gaussian."""
    spread = {"class_name": "GaussianDistribution", "init_std": ppo.action_std, "std_type": "log"}
    return network_settings(ppo) | {"distribution_cfg": spread}


def load_agent(path: Path, config: RslTraining, layout: ObservationLayout, action_size: int, device: str) -> Agent:
    """Load the agent of an earlier training.

    Args:
        path: of its ``policy.pt``, or of the checkpoint of one that was interrupted; nothing in it is unpickled.
        config: resolved.
        layout: of the observation.
        action_size: length of an action.
        device: torch's, where to compute.

    Raises:
        ConfigError: the file holds no policy of that configuration.
    """
    seen = components(layout, config.observe)
    settings = actor_settings(config.ppo)
    network = resolve_callable(settings.pop("class_name"))
    shown = TensorDict({"policy": torch.zeros(1, len(seen))}, [1])
    actor = network(shown, {"actor": ["policy"]}, "actor", action_size, **settings).to(device)
    try:
        interrupted = path.name == CHECKPOINT
        actor.load_state_dict(
            read_checkpoint(path)["state"]["algorithm"]["actor_state_dict"]
            if interrupted
            else load_weights(path, device)
        )
    except UNREADABLE as error:
        raise policy_mismatch(path, len(seen), action_size, error) from None
    return mean_agent(actor.eval(), seen, device)


def mean_agent(actor: torch.nn.Module, seen: Sequence[int], device: str) -> Agent:
    """Return the agent of a policy's mean actions, from observations ``(n, 1, size)`` to ``(n, 1, action_size)``.

    Args:
        actor: rsl_rl's.
        seen: components of the observation that it sees.
        device: its.
    """

    def act(observation: np.ndarray) -> np.ndarray:
        shown = torch.as_tensor(observation[:, 0][:, seen], device=device)
        with torch.no_grad():
            return actor(TensorDict({"policy": shown}, [len(shown)]))[:, None].cpu().numpy()

    return act
