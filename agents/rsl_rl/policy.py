"""Policies of rsl_rl's PPO: the settings of their training runs, their networks, and agents out of files."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, Field, model_validator
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict

from agents.batch_training import BatchTraining, load_batched
from agents.checkpoint import load_weights, policy_mismatch, read_checkpoint
from agents.config import ClipRange, Discount, EntropyWeight, GaeLambda, ValueWeight, Widths
from agents.evaluate import Agent, Seen
from agents.files import CHECKPOINT
from agents.rsl_rl.curriculum import AssistSchedule, MotionSchedule
from agents.sb3.workers import components
from piavatar_envs.api.host import picture_spaces
from piavatar_envs.api.rsl_rl import picture_groups
from piavatar_envs.config import FROZEN, ConfigError, EnvConfig, FrozenDict, load_config
from piavatar_envs.core.reading import UNREADABLE
from piavatar_envs.envs.observations import ObservationLayout
from piavatar_envs.tasks import load_task


class ConvolutionSettings(BaseModel):
    """Convolutions before the hidden layers of each network.

    The defaults are those of Mnih et al., "Human-level control through deep reinforcement learning", Nature 2015.
    """

    model_config = FROZEN

    channels: Widths = Field((32, 64, 64), min_length=1, description="channels after each convolution")
    kernels: Widths = Field((8, 4, 3), min_length=1, description="widths of the kernels [pixel]")
    strides: Widths = Field((4, 2, 1), min_length=1, description="strides [pixel]")

    @model_validator(mode="after")
    def _check_lengths(self) -> ConvolutionSettings:
        """Refuse lists of different lengths."""
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise ConfigError(
                f"channels={list(self.channels)}, kernels={list(self.kernels)} and strides={list(self.strides)} must "
                "have one entry a convolution each"
            )
        return self


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
    discount: Discount = 0.9
    reward_scale: float = Field(
        1.0,
        gt=0.0,
        description="factor on what the networks see of a reward [-]; the critic follows by clip_range a step, so "
        "discounted returns should be about 1",
    )
    gae_lambda: GaeLambda = 0.8
    clip_range: ClipRange = 0.2
    value_weight: ValueWeight = 1.0
    entropy_weight: EntropyWeight = 0.0
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
    convolutions: ConvolutionSettings = Field(
        default_factory=ConvolutionSettings, description="layers before these, which see pictures"
    )


class RslTraining(BatchTraining):
    """Settings of a training run with rsl_rl.

    Class attributes:
        obs_modes: what the networks take.
    """

    obs_modes: ClassVar[tuple[str, ...]] = ("flat", "pixels", "pixels+state")

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


def network_settings(ppo: RslPPOSettings, sees: Collection[str]) -> dict[str, Any]:
    """Return the settings of a network as rsl_rl takes them.

    Args:
        ppo: the algorithm's.
        sees: names of the observation groups that it sees.
    """
    settings = {
        "class_name": "MLPModel",
        "hidden_dims": list(ppo.hidden),
        "activation": "tanh",
        "obs_normalization": ppo.normalize_observation,
    }
    if set(sees) == {"policy"}:
        return settings
    layers = ppo.convolutions
    convolutions = {
        "output_channels": list(layers.channels),
        "kernel_size": list(layers.kernels),
        "stride": list(layers.strides),
        "activation": "relu",
    }
    return settings | {"class_name": "CNNModel", "cnn_cfg": convolutions}


def actor_settings(ppo: RslPPOSettings, sees: Collection[str]) -> dict[str, Any]:
    """Return the settings of the actor, whose outputs are means of a Gaussian; arguments as for the network."""
    spread = {"class_name": "GaussianDistribution", "init_std": ppo.action_std, "std_type": "log"}
    return network_settings(ppo, sees) | {"distribution_cfg": spread}


def shown_groups(config: RslTraining, components: int) -> TensorDict:
    """Return an observation of zeros, by the groups that the networks see: ``policy``, and pictures by their names.

    Args:
        config: resolved.
        components: of the flat observation that are seen.
    """
    settings: EnvConfig = load_config(load_task(config.env_id).Config, config.env)
    groups = {} if settings.obs_mode == "pixels" else {"policy": torch.zeros(1, components)}
    if settings.observes_pixels:
        spaces = picture_spaces(settings.pixels)
        groups |= {name: torch.zeros(1, *np.moveaxis(np.empty(s.shape), -1, 0).shape) for name, s in spaces.items()}
    return TensorDict(groups, [1])


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
    shown = shown_groups(config, len(seen))
    settings = actor_settings(config.ppo, shown.keys())
    network = resolve_callable(settings.pop("class_name"))
    actor = network(shown, {"actor": list(shown.keys())}, "actor", action_size, **settings).to(device)
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
        seen: components of the flat observation that it sees.
        device: its.
    """

    def act(observation: Seen) -> np.ndarray:
        own = observation if isinstance(observation, Mapping) else {"state": observation}
        pictures = {name: torch.as_tensor(own[name][:, 0], device=device) for name in own if name != "state"}
        state = torch.as_tensor(own["state"][:, 0][:, seen], device=device)
        groups = TensorDict({"policy": state} | picture_groups(pictures), [len(state)])
        with torch.no_grad():
            return actor(groups)[:, None].cpu().numpy()

    return act
