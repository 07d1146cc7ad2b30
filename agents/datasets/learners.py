"""Policies out of a dataset, with TorchRL's losses: behaviour cloning, and implicit Q-learning as offline RL.

Both have the same actor, a Gaussian with a mean in (-1, 1) and a spread of its own for every component. Networks and
hyper-parameters are those of Kostrikov, Nair & Levine, "Offline reinforcement learning with implicit Q-learning", 2022,
for locomotion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from tqdm import tqdm

from agents.checkpoint import check_finite
from agents.evaluate import Agent, Seen

if TYPE_CHECKING:  # of the extra datasets
    from torchrl.modules import MLP, ProbabilisticActor
    from torchrl.objectives import SoftUpdate

HIDDEN, BATCH, LEARNING_RATE = [256, 256], 256, 3e-4
#: Of implicit Q-learning: discount, expectile of the value, inverse temperature, and averaging of the targets.
DISCOUNT, EXPECTILE, TEMPERATURE, AVERAGING = 0.99, 0.7, 3.0, 0.005
#: Least standard deviation by which a component of an observation is divided: what hardly moves is not blown up.
LEAST_STD = 1e-2


@dataclass(frozen=True)
class Statistics:
    """Mean and standard deviation of the observations of a dataset, shape ``(size,)`` each."""

    mean: torch.Tensor
    std: torch.Tensor

    def __call__(self, observation: torch.Tensor) -> torch.Tensor:
        """Return observations with mean 0 and standard deviation 1."""
        return (observation - self.mean) / self.std


def transitions(dataset: Any) -> TensorDict:
    """Return the steps of a Minari dataset with flat observations, in the keys that TorchRL's losses read."""
    parts = []
    for episode in dataset.iterate_episodes():
        seen = torch.as_tensor(np.asarray(episode.observations), dtype=torch.float32)
        ended = torch.as_tensor(episode.terminations)[:, None]
        following = {
            "observation": seen[1:],
            "reward": torch.as_tensor(episode.rewards, dtype=torch.float32)[:, None],
            "terminated": ended,
            "done": ended | torch.as_tensor(episode.truncations)[:, None],
        }
        done = torch.as_tensor(np.asarray(episode.actions), dtype=torch.float32)
        parts.append(TensorDict({"observation": seen[:-1], "action": done, "next": following}, [len(done)]))
    return torch.cat(parts)


def make_actor(size: int, action_size: int) -> ProbabilisticActor:
    """Return a Gaussian actor for normalized observations."""
    from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

    net = nn.Sequential(
        MLP(in_features=size, out_features=action_size, num_cells=HIDDEN, activation_class=nn.ReLU),
        nn.Tanh(),
        AddStateIndependentNormalScale(action_size),
    )
    return ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


def _cloning(actor: ProbabilisticActor, size: int, action_size: int) -> tuple[nn.Module, SoftUpdate | None]:
    from torchrl.objectives import BCLoss

    return BCLoss(actor), None


def _implicit_q(actor: ProbabilisticActor, size: int, action_size: int) -> tuple[nn.Module, SoftUpdate]:
    from torchrl.modules import MLP, ValueOperator
    from torchrl.objectives import IQLLoss, SoftUpdate

    def net(inputs: int) -> MLP:
        return MLP(in_features=inputs, out_features=1, num_cells=HIDDEN, activation_class=nn.ReLU)

    loss = IQLLoss(
        actor,
        ValueOperator(net(size + action_size), in_keys=["observation", "action"]),
        ValueOperator(net(size), in_keys=["observation"]),
        loss_function="l2",
        temperature=TEMPERATURE,
        expectile=EXPECTILE,
    )
    loss.make_value_estimator(gamma=DISCOUNT)
    return loss, SoftUpdate(loss, tau=AVERAGING)


#: Learners by name: the loss of an actor, and the averaging of its targets if it has any.
LEARNERS: dict[str, Callable[[ProbabilisticActor, int, int], tuple[nn.Module, SoftUpdate | None]]] = {
    "bc": _cloning,
    "iql": _implicit_q,
}


def learn(name: str, data: TensorDict, updates: int, seed: int = 0, device: str = "cpu") -> Agent:
    """Learn a policy and return the agent of its mean actions.

    Args:
        name: of :data:`LEARNERS`.
        data: as :func:`transitions` returns it.
        updates: gradient steps.
        seed: of networks and batches.
        device: torch's.

    Raises:
        agents.checkpoint.Diverged: networks are no longer finite.
    """
    from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

    torch.manual_seed(seed)
    spread = data["observation"].std(0).clamp_min(LEAST_STD)
    seen = Statistics(data["observation"].mean(0).to(device), spread.to(device))
    size, action_size = data["observation"].shape[-1], data["action"].shape[-1]
    actor = make_actor(size, action_size).to(device)
    loss, targets = LEARNERS[name](actor, size, action_size)
    loss = loss.to(device)
    optimizer = torch.optim.Adam(loss.parameters(), LEARNING_RATE)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data), device=device), batch_size=BATCH)
    ready = data.to(device).clone()
    for steps in (ready, ready["next"]):
        steps["observation"] = seen(steps["observation"])
    buffer.extend(ready)
    for _ in tqdm(range(updates), desc=f"learn {name}", unit="update", dynamic_ncols=True):
        losses = loss(buffer.sample())
        optimizer.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()
        if targets is not None:
            targets.step()
    shown = TensorDict({"observation": ready["observation"][:BATCH]}, [min(BATCH, len(data))])
    with torch.no_grad():
        check_finite({name: loss}, {"mean action": actor(shown)["loc"]}, updates, ("learning rate", LEARNING_RATE))
    return _mean_agent(actor, seen, device)


def _mean_agent(actor: ProbabilisticActor, normalize: Statistics, device: str) -> Agent:
    """Return the agent of an actor's means, from observations ``(n, 1, size)`` to ``(n, 1, action_size)``."""

    def act(observation: Seen) -> np.ndarray:
        seen = normalize(torch.as_tensor(observation[:, 0], device=device))
        with torch.no_grad():
            return actor(TensorDict({"observation": seen}, [len(seen)]))["loc"][:, None].cpu().numpy()

    return act
