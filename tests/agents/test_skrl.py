"""Training by skrl's MAPPO: the published configurations, what is learned from, and where episodes really end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from tests.conftest import only_one_process

torch = pytest.importorskip("torch", reason="needs the extras train and skrl")
pytest.importorskip("skrl", reason="needs the extra skrl")
pytest.importorskip("pettingzoo", reason="needs the extra multi")

from agents.batch_training import load_batched, new_task  # noqa: E402
from agents.checkpoint import Checkpoint  # noqa: E402
from agents.skrl import train as skrl_mappo  # noqa: E402
from piavatar_envs.api.skrl import AvatarSkrlMultiEnv  # noqa: E402
from piavatar_envs.config import ConfigError  # noqa: E402
from tests.agents.killing import flat, killed_in_step  # noqa: E402

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs" / "skrl").glob("*.yaml"))
TINY = (
    "env.fidelity=tiny", "env.episode_seconds=0.3", "num_envs=2", "iterations=2", "mappo.rollout_steps=10",
    "mappo.minibatches=2", "mappo.epochs=2", "evaluation.episodes=2",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def kernels(device):
    """Compile once: parallel test workers would race each other's files."""
    with only_one_process("kernels"):
        skrl_mappo.find_world("high_five_v0")
        wp.force_load(device)


@pytest.fixture(scope="module")
def config():
    algorithm = {"rollout_steps": 4, "epochs": 2, "minibatches": 2}
    settings = {"env": {"fidelity": "tiny", "episode_seconds": 0.3}, "num_envs": 2, "mappo": algorithm}
    return load_batched(skrl_mappo.MAPPOTraining, skrl_mappo.find_world, settings)


@pytest.fixture(scope="module")
def env(config, device):
    """Two worlds."""
    made = AvatarSkrlMultiEnv(skrl_mappo.find_world(config.env_id), 2, device, config.env)
    yield made
    made.close()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_published_configurations_train_and_leave_their_results(path, device, tmp_path, capsys):
    skrl_mappo.main([str(path), *TINY, "--out", str(tmp_path), "--device", device])
    assert "trained" in capsys.readouterr().out
    left = {entry.name for entry in tmp_path.iterdir()}
    assert {"policy.pt", "curve.png", "curve.csv", "config.yaml", "results.json"} <= left
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["benchmark"] == "skrl.train" and results["agents"] == ["agent_0", "agent_1"]
    assert [row["case"] for row in results["results"]] == ["zero", "random", "trained"]
    assert all(len(row["agent_return_mean"]) == 2 for row in results["results"])
    # 20 steps of two worlds, whose episodes have 9
    curve = np.loadtxt(tmp_path / "curve.csv", delimiter=",", skiprows=1)
    assert curve[:, 0].tolist() == [18, 18, 36, 36] and np.isfinite(curve).all()


def test_networks_see_the_chosen_terms_of_their_agents(config, env, tmp_path):
    config = config.model_copy(update={"observe": ("own_hand",)})
    mappo = skrl_mappo.build(config, env, tmp_path)
    layout = env.observation_layout
    own, size = layout["own_hand"].slice, layout.size
    for index, name in enumerate(env.possible_agents):
        policy, critic = mappo.policies[name], mappo.values[name]
        torch.nn.init.normal_(critic.net[-1].weight)
        assert policy.seen.tolist() == list(range(own.start, own.stop))
        state = torch.zeros(1, 2 * size, device=env.device)
        value = critic.compute({"states": state})[0]
        for agent in range(2):
            for place, matters in ((own.start, True), (own.stop, False)):
                moved = state.clone()
                moved[0, agent * size + place] = 1.0
                changed = not torch.equal(critic.compute({"states": moved})[0], value)
                assert changed == matters, f"{name} (agent {index}): component {place} of agent {agent}"


def played(mappo, env, steps: int) -> list[dict]:
    """Let the worlds be stepped, and every transition be recorded, as skrl's trainer does it.

    From the third step on, agent 1 of world 0 is said to be out.
    """
    mappo.init()
    mappo.enable_training_mode(True)
    observed, _ = env.reset(seed=1)
    state, steps_taken = env.state(), []
    for step in range(steps):
        where = {"timestep": step, "timesteps": steps}
        with torch.no_grad():
            actions, _ = mappo.act(observed, dict.fromkeys(env.agents, state), **where)
            after, rewards, terminated, truncated, infos = env.step(actions)
            infos["acted"]["agent_1"][0] = step < 2
            column = [{k: v.view(-1, 1) for k, v in flags.items()} for flags in (rewards, terminated, truncated)]
            steps_taken.append({"rewards": rewards, "truncated": truncated, "infos": infos, "after": after})
            mappo.record_transition(
                observations=observed, states=dict.fromkeys(env.agents, state), actions=actions,
                rewards={k: v.clone() for k, v in column[0].items()}, next_observations=after,
                next_states=dict.fromkeys(env.agents, env.state()), terminated=column[1], truncated=column[2],
                infos=infos, **where,
            )  # fmt: skip
        observed, state = after, env.state()
    return steps_taken


def test_a_time_out_is_worth_what_its_own_end_is_worth(config, env, tmp_path):
    """Not what the first observation of the next episode is, which skrl would take."""
    config = config.model_copy(update={"mappo": config.mappo.model_copy(update={"rollout_steps": 9})})
    mappo = skrl_mappo.build(config, env, tmp_path)
    for critic in mappo.values.values():
        torch.nn.init.normal_(critic.net[-1].weight)
    steps_taken = played(mappo, env, 18)
    last = steps_taken[-1]
    assert all(flags.all() for flags in last["truncated"].values()), "an episode has 9 steps"
    for name in env.agents:
        stored = mappo.memories[name].get_tensor_by_name("rewards")[8, :, 0]
        with torch.no_grad():
            ends = mappo.values[name].compute({"states": last["infos"]["final_state"]})[0][:, 0]
            starts = mappo.values[name].compute({"states": env.state()})[0][:, 0]
        expected = last["rewards"][name] + config.mappo.discount * ends
        assert torch.allclose(stored, expected, atol=1e-5) and (starts - ends).abs().min() > 1e-3
    assert mappo.curve.steps == [18, 18, 36, 36]
    means = torch.stack([torch.stack(list(one["rewards"].values())).mean(dim=0) for one in steps_taken])
    assert mappo.curve.returns == pytest.approx(means.view(2, 9, 2).sum(dim=1).flatten().tolist(), abs=1e-6)


def test_only_an_agents_own_steps_are_learned_from(device):
    memory = skrl_mappo.ActedMemory(3, 2, device)
    memory.create_tensor("observations", size=1)
    memory.create_tensor("advantages", size=1)
    acted = torch.tensor([[True, True], [True, False], [True, False]])
    for step in range(3):
        memory.acted[memory.memory_index] = acted[step].to(memory.device)
        memory.add_samples(observations=torch.tensor([[10.0 * step], [10.0 * step + 1]], device=memory.device))
    raw = torch.tensor([[1.0, 2.0], [3.0, 100.0], [6.0, -50.0]], device=memory.device)[..., None]
    memory.set_tensor_by_name("advantages", (raw - raw.mean()) / raw.std())  # as skrl normalises them
    batches = memory.sample(["observations", "advantages"], batch_size=6, mini_batches=2)
    seen = torch.cat([batch[0] for batch in batches]).flatten()
    assert sorted(seen.tolist()) == [0.0, 1.0, 10.0, 20.0] and [len(batch[0]) for batch in batches] == [2, 2]
    counted = torch.cat([batch[1] for batch in batches]).flatten()
    assert counted.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert counted.std(unbiased=False).item() == pytest.approx(1.0, rel=1e-4)
    # what is learned does not depend on steps of agents that were out
    alone = torch.tensor([1.0, 2.0, 3.0, 6.0])
    expected = (alone - alone.mean()) / alone.std(unbiased=False)
    assert sorted(counted.tolist()) == pytest.approx(sorted(expected.tolist()), abs=1e-5)
    memory.acted[:] = False
    assert memory.sample(["observations"], batch_size=6, mini_batches=2) == []


def test_training_repeats_and_depends_on_its_seed(config, env, device, tmp_path):
    actions, first_layers = [], []
    seen = np.random.default_rng(0).normal(size=(3, 2, env.observation_layout.size)).astype(np.float32)
    for run, (seed, iterations) in enumerate(((0, 2), (0, 2), (1, 2), (0, 1))):
        folder = tmp_path / str(run)
        folder.mkdir()
        changed = config.model_copy(update={"seed": seed, "iterations": iterations})
        task = new_task(changed, skrl_mappo.find_world)
        checkpoint = Checkpoint(folder, "skrl.train", changed, device, resume=False)
        actions.append(skrl_mappo.learn(changed, task, folder, device, checkpoint).agent(seen))
        saved = torch.load(folder / "policy.pt", weights_only=False, map_location="cpu")
        first_layers.append(saved["agent_1"]["policy"]["net.0.weight"])
    assert actions[0].shape == (3, 2, env.action_spaces["agent_0"].shape[0])
    assert np.array_equal(actions[0], actions[1])
    assert np.abs(actions[0] - actions[2]).max() > 1e-3, "another seed"
    assert (first_layers[0] - first_layers[2]).abs().mean() > 1e-2, "of the networks, too"
    assert np.abs(actions[0] - actions[3]).max() > 1e-5, "an update less"


def test_what_is_interrupted_goes_on_as_if_it_had_not_been(config, device, tmp_path):
    """Interrupted in the fourth iteration, after the second one was kept, and finished; then made longer."""

    def run(name: str, iterations: int, resume: bool = True):
        changed = config.model_copy(update={"iterations": iterations, "checkpoint_every": 2})
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        checkpoint = Checkpoint(folder, "skrl.train", changed, device, resume)
        curve = skrl_mappo.learn(changed, new_task(changed, skrl_mappo.find_world), folder, device, checkpoint).curve
        saved = torch.load(folder / "checkpoint.pt", weights_only=True)["state"]
        return curve.steps, curve.returns, flat({name: saved[name] for name in ("agents", "envs", "playing", "random")})

    whole = run("whole", 5)
    with killed_in_step(skrl_mappo.Worlds, 3 * config.mappo.rollout_steps + 4):
        run("parts", 4)
    assert torch.load(tmp_path / "parts" / "checkpoint.pt", weights_only=True)["state"]["iterations"] == 2
    run("parts", 4)
    run("parts", 4)  # there is nothing left to do
    assert run("parts", 5) == whole and len(whole[0]) >= 4
    with pytest.raises(ConfigError, match="has had 5 iterations, iterations=3; ask for as many or more"):
        run("parts", 3)
