"""Contracts of every game: PettingZoo's own tests, determinism, agents that leave, refusals, no shared memory."""

from __future__ import annotations

import copy
import functools
import importlib
import pickle
import subprocess
import sys
import types
import warnings

import gymnasium
import numpy as np
import pettingzoo.test as official
import pytest

from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.tasks.games import game_modules

#: PettingZoo's complaints that are wanted: these observations have no honest limits.
UNBOUNDED = r"Agent's (minimum|maximum) observation space value is -?infinity.*"

#: Terms that need a touch, an agent that leaves or a pass to change; they are tested where that happens.
RARE = ("contact_impulse", "others_in", "turn")


@pytest.fixture
def strict():
    """Warnings of PettingZoo's tests are failures."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", UNBOUNDED)
        yield


def fresh(games, game_name, device):
    """The module with quick settings, as PettingZoo's tests want it; wrappers of the AEC view included."""
    settings = {"fidelity": "tiny", "device": device}
    module = games[game_name]
    return types.SimpleNamespace(
        parallel_env=functools.partial(module.parallel_env, **settings), env=functools.partial(module.env, **settings)
    )


def test_games_are_found():
    assert {"sumo_v0", "boxing_v0"} <= set(listed_games()) and set(game_modules()) <= set(listed_games())
    assert load_game("sumo_v0").TASK is importlib.import_module("piavatar_envs.multi.sumo_v0").TASK
    with pytest.raises(ValueError, match=r"'sumo_v9'; did you mean sumo_v0\?"):
        load_game("sumo_v9")
    with pytest.raises(ValueError, match=r"did you mean PIAvatar/Reach-v0\?"):
        load_game("raech", ["PIAvatar/Reach-v0"])


def test_listing_the_games_is_light():
    code = """
import sys
from piavatar_envs.multi import listed_games
assert listed_games()
print([name for name in ("pettingzoo", "warp", "torch", "pyvista") if name in sys.modules])
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert run.stdout.strip() == "[]", run.stdout + run.stderr


def test_pettingzoos_parallel_test(games, game_name, device, strict, capsys):
    official.parallel_api_test(fresh(games, game_name, device).parallel_env(max_cycles=12), num_cycles=15)
    assert "Passed Parallel API test" in capsys.readouterr().out


def test_pettingzoos_aec_test(games, game_name, device, strict, capsys):
    official.api_test(fresh(games, game_name, device).env(max_cycles=8), num_cycles=30)
    assert "Passed API test" in capsys.readouterr().out


def test_pettingzoos_seed_tests(games, game_name, device):
    module = fresh(games, game_name, device)
    official.seed_test(module.env, num_cycles=5)
    official.parallel_seed_test(module.parallel_env, num_cycles=2)


def test_pettingzoos_clock_test(games, game_name, device):
    official.max_cycles_test(fresh(games, game_name, device))


def test_same_seed_and_actions_give_the_same_run(make_game, play, same, game_name):
    world, twin = make_game(game_name), make_game(game_name, twin=1)
    runs = []
    for env in (world, twin, world):
        env.reset(seed=9)
        env.reset(seed=5)
        rng = np.random.default_rng(0)
        runs.append([])
        for seed in (None, None):
            runs[-1] += [env.reset(seed=seed), *play(env, 25, rng)]
    assert same(runs[0], runs[1]) and same(runs[0], runs[2])


def test_seeds_and_episodes_differ(make_game, game_name, games, device):
    world = make_game(game_name)
    starts = {f"seed {seed}": world.reset(seed=seed)[0] for seed in (0, 1, 2)}
    starts |= {f"episode {n} of seed 2": world.reset()[0] for n in (1, 2)}
    module = fresh(games, game_name, device)
    starts |= {f"unseeded {n}": module.parallel_env().reset()[0] for n in (0, 1)}
    names = list(starts)
    for i, a in enumerate(names):
        for b in names[:i]:
            for agent in world.possible_agents:
                assert np.abs(starts[a][agent] - starts[b][agent]).max() > 1e-4, f"{a} is {b} for {agent}"


def test_agents_differ_at_the_start(make_game, game_name):
    """They draw apart: a world whose agents begin alike teaches them less."""
    world = make_game(game_name)
    observations, _ = world.reset(seed=0)
    joints = world.observation_layout["joint_rotations"].slice
    first, *others = (observation[joints] for observation in observations.values())
    assert all(np.abs(other - first).max() > 1e-3 for other in others)


@pytest.mark.parametrize("seed", [-1, 2**32, "one", 1.5])
def test_what_is_no_seed_is_refused(make_game, game_name, seed):
    with pytest.raises((ValueError, gymnasium.error.Error)):
        make_game(game_name).reset(seed=seed)


def test_observations_are_finite_and_none_is_constant(make_game, play, game_name):
    world = make_game(game_name)
    rng, seen = np.random.default_rng(0), {name: [] for name in world.possible_agents}
    for seed in range(4):
        rows = [world.reset(seed=seed), *play(world, 20, rng)]
        for observations, *_ in rows:
            for name, observation in observations.items():
                assert world.observation_space(name).contains(observation) and observation.dtype == np.float32
                seen[name].append(observation)
    for name, rows in seen.items():
        rows = np.array(rows)
        assert np.isfinite(rows).all()
        for term in world.observation_layout.values():
            spread = np.ptp(rows[:, term.slice], axis=0)
            assert term.name in RARE or (spread > 0.0).all(), f"{name}: {term.name} never changes"


@pytest.mark.parametrize("kind", ["uniform", "corners", "held corners"])
def test_no_failure_under_full_actions(make_game, game_name, kind):
    """And nothing that is not finite; an agent that is out does not act; a new episode begins when all are out."""
    world, rng = make_game(game_name), np.random.default_rng(0)
    world.reset(seed=0)
    size, actions = world.action_space(world.possible_agents[0]).shape, {}
    for step in range(40):
        if not world.agents:
            world.reset()
        for name in world.possible_agents:
            if kind == "uniform":
                actions[name] = rng.uniform(-1.0, 1.0, size)
            elif kind == "corners" or step % 8 == 0:
                actions[name] = rng.choice([-1.0, 1.0], size)
        observations, rewards, _, _, infos = world.step({name: actions[name] for name in world.agents})
        for name, info in infos.items():
            assert info["failure"] is None, f"step {step}: {info['failure']}"
            assert np.isfinite(observations[name]).all() and np.isfinite(rewards[name])


def test_state_is_what_all_see(make_game, play, game_name):
    world = make_game(game_name)
    observations, _ = world.reset(seed=0)
    assert np.array_equal(world.state(), np.concatenate([observations[name] for name in world.possible_agents]))
    assert world.state_space.contains(world.state())
    before = world.state()
    play(world, 2)
    assert not np.array_equal(before, world.state()) and np.isfinite(before).all()


def test_a_copy_goes_on_as_the_original(make_game, play, same, game_name):
    """By both ways, over the end of the episode; also where an agent has left, and where all agents have left."""
    world = make_game(game_name, max_cycles=6)
    assert copy.deepcopy(world).agents == world.agents
    for steps in (2, 4, 6):
        world.reset(seed=3)
        play(world, steps, np.random.default_rng(0))
        if steps == 4:
            state = world.get_state()
            state["env.alive"][0, 0], state["env.terminated"][0, 0] = False, True
            world.set_state(state)
        copies = copy.deepcopy(world), pickle.loads(pickle.dumps(world))
        runs = []
        for env in (world, *copies):
            rng = np.random.default_rng(1)
            runs.append([env.agents, play(env, 9, rng), env.agents, env.reset(), env.agents, play(env, 9, rng)])
        assert same(runs[0], runs[1]) and same(runs[0], runs[2])


def test_a_copy_of_what_was_never_reset_needs_one(games, game_name, device):
    world = fresh(games, game_name, device).parallel_env()
    for other in (copy.deepcopy(world), pickle.loads(pickle.dumps(world))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            other.step({})
        assert other.reset(seed=1) and other.agents == other.possible_agents


def test_the_aec_view_is_copied(games, game_name, device, same):
    env = fresh(games, game_name, device).env(max_cycles=4)
    env.reset(seed=1)
    env.step(np.zeros(env.action_space(env.agent_selection).shape, np.float32))
    runs = []
    for view in (copy.deepcopy(env), pickle.loads(pickle.dumps(env)), env):
        runs.append([])
        for agent in view.agent_iter():
            runs[-1].append((agent, *view.last()))
            ended = view.terminations[agent] or view.truncations[agent]
            view.step(None if ended else np.full(view.action_space(agent).shape, 0.5, np.float32))
    assert same(runs[0], runs[2]) and same(runs[1], runs[2])


def test_spaces_belong_to_the_agents(make_game, game_name):
    world = make_game(game_name)
    for spaces, space in (
        (world.action_spaces, world.action_space),
        (world.observation_spaces, world.observation_space),
    ):
        assert all(space(name) is space(name) is spaces[name] for name in world.possible_agents)
        assert len({id(space) for space in spaces.values()}) == len(world.possible_agents)
    assert len(world.action_names) == world.action_space(world.possible_agents[0]).shape[0]


def test_metadata(make_game, game_name):
    metadata = make_game(game_name).metadata
    assert metadata["name"] == game_name.rpartition(".")[2] == str(make_game(game_name))
    assert metadata["render_modes"] == ["rgb_array", "human"] and metadata["is_parallelizable"]
    assert metadata["render_fps"] == 30 and make_game(game_name, control_dt=0.02).metadata["render_fps"] == 50


def test_dictionary_is_the_flat_vector_by_name(make_game, play, same, game_name):
    flat, named = make_game(game_name), make_game(game_name, obs_mode="dict")
    rows = [(env.reset(seed=8), *play(env, 3, np.random.default_rng(1))) for env in (flat, named)]
    for (vectors, *_), (terms, *_) in zip(*rows, strict=True):
        for name, vector in vectors.items():
            assert named.observation_space(name).contains(terms[name])
            assert same(flat.observation_layout.split(vector), terms[name])
    assert same(flat.state(), named.state())


def test_what_a_step_tells(make_game, play, game_name):
    world, task = make_game(game_name), make_game(game_name).batch.task
    _, infos = world.reset(seed=1)
    assert set(infos) == set(world.possible_agents) and all(info["failure"] is None for info in infos.values())
    for observations, rewards, terminations, truncations, infos in play(world, 15, np.random.default_rng(2)):
        keys = [set(found) for found in (observations, rewards, terminations, truncations, infos)]
        assert all(found == keys[0] for found in keys)
        for name, info in infos.items():
            assert type(rewards[name]) is float and type(terminations[name]) is bool and type(truncations[name]) is bool
            terms = info["reward_terms"]
            assert tuple(terms) == task.reward_names and np.isfinite(list(terms.values())).all()
            assert rewards[name] == pytest.approx(sum(terms.values()), abs=1e-5)
            assert all(np.isfinite(info[metric]) for metric in task.metric_names)
            assert type(info["success"]) is bool and info["failure"] is None and type(info["root_released"]) is bool
            assert info["root_force"].shape == info["root_torque"].shape == (3,)
            assert ("cost" in info) == bool(task.cost_names)


def test_every_agent_is_told_its_own(make_game, game_name):
    """Only one acts: only its action costs, and what holds the two differs."""
    world = make_game(game_name)
    first, second, *_ = world.possible_agents
    world.reset(seed=0)
    actions = {name: np.zeros(world.action_space(name).shape) for name in world.agents}
    actions[second] += 1.0
    infos = world.step(actions)[4]
    force = {name: infos[name]["root_force"] for name in infos}
    assert not np.allclose(force[first], force[second], rtol=1e-3)
    for index, name in enumerate(world.possible_agents):
        drive = world.batch.simulation.avatars[index].state
        assert np.array_equal(force[name], drive.wrench_force.numpy()[0])


def arrays_in(value) -> list[np.ndarray]:
    if isinstance(value, dict):
        return [array for item in value.values() for array in arrays_in(item)]
    if isinstance(value, (tuple, list)):
        return [array for item in value for array in arrays_in(item)]
    return [value] if isinstance(value, np.ndarray) and value.ndim else []


def test_returned_arrays_are_the_callers(make_game, play, same, game_name):
    world = make_game(game_name)
    internal = [array.numpy() for array in (*world.batch.arrays().values(), world.batch.observation)]
    returned = arrays_in([world.reset(seed=1), *play(world, 3), world.state(), world.set_state(world.get_state())])
    for i, a in enumerate(returned):
        assert a.flags.writeable
        assert not any(np.shares_memory(a, b) for b in returned[:i]) and not any(
            np.shares_memory(a, b) for b in internal
        )
    untouched = [world.reset(seed=1), *play(world, 3)]
    for array in arrays_in([world.reset(seed=1)]):
        array[:] = np.nan
    again = play(world, 3)
    assert same([row[0] for row in untouched[1:]], [row[0] for row in again])


def test_actions_are_not_written_to(make_game, game_name):
    world = make_game(game_name)
    world.reset(seed=0)
    actions = {name: np.full(world.action_space(name).shape, 3.0, np.float32) for name in world.agents}
    world.step(actions)
    assert all((action == 3.0).all() for action in actions.values())


def spoiled(world, how: str) -> dict[str, np.ndarray]:
    first, *_, last = world.agents
    actions = {name: np.zeros(world.action_space(name).shape) for name in world.agents}
    if how == "missing":
        del actions[last]
    elif how == "nobody":
        actions = {}
    elif how == "stranger":
        actions["agent_99"] = actions[first]
    elif how == "shape":
        actions[last] = np.zeros(3)
    elif how == "nan":
        actions[last][1] = np.nan
    elif how == "none":
        actions[last] = None
    elif how == "no dictionary":
        return list(actions.values())
    return actions


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("missing", "no action for LAST; the agents that act are agent_0, "),
        ("nobody", "no action for agent_0, agent_1"),
        ("stranger", "an action for agent_99; the agents that act are agent_0, agent_1"),
        ("shape", r"LAST: action has shape \(3,\)"),
        ("nan", r"LAST: action\[1\] \(.*\) is nan"),
        ("none", "LAST: action has shape"),
        ("no dictionary", "actions are a list; give a dictionary of one for each of agent_0, agent_1"),
    ],
)
def test_bad_actions_are_refused_before_anything_changes(make_game, game_name, how, told):
    world = make_game(game_name)
    world.reset(seed=0)
    before, state = world.get_state(), world.state()
    with pytest.raises(ValueError, match=told.replace("LAST", world.agents[-1])):
        world.step(spoiled(world, how))
    after = world.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    assert np.array_equal(world.state(), state) and world.agents == world.possible_agents


def test_nothing_goes_before_the_first_reset_or_after_the_end(games, game_name, device, play):
    world = fresh(games, game_name, device).parallel_env(max_cycles=2, render_mode="rgb_array")
    assert world.agents == []
    for call in (lambda: world.step({}), world.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    world.reset(seed=0)
    truncations = [row[3] for row in play(world, 5)]
    assert len(truncations) == 2 and all(truncations[1].values()) and not any(truncations[0].values())
    assert world.agents == []
    with pytest.raises(gymnasium.error.ResetNeeded, match="all agents have left"):
        world.step({})
    world.reset()
    assert world.agents == world.possible_agents


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"max_cycles": 0}, "max_cycles=0 must be a whole number, at least 1"),
        ({"max_cycles": 1.5}, "max_cycles=1.5 must be a whole number, at least 1"),
        ({"render_mode": "ansi"}, "render_mode='ansi' is not known; use None, rgb_array or human"),
        ({"bogus": 1}, "bogus is no setting of"),
        ({"device": "tpu"}, "device='tpu'"),
        ({"scene": {"avatars": [{"yaw": 0.0}] * 9}}, "scene.avatars has 9 entries"),
    ],
)
def test_bad_settings_are_refused_in_one_line(games, game_name, device, settings, told):
    with pytest.raises(ValueError) as caught:
        games[game_name].parallel_env(**{"fidelity": "tiny", "device": device, **settings})
    assert told in str(caught.value) and "\n" not in str(caught.value)


def test_max_cycles_wins_over_episode_seconds(games, game_name, device):
    world = fresh(games, game_name, device).parallel_env(max_cycles=7, episode_seconds=3.0)
    assert world.batch.max_steps == 7
    assert fresh(games, game_name, device).parallel_env(episode_seconds=3.0).batch.max_steps == 90


def test_a_run_taken_up_again_is_the_same(make_game, play, same, game_name):
    world, other = make_game(game_name), make_game(game_name, twin=1)
    world.reset(seed=6)
    world.reset()
    play(world, 8, np.random.default_rng(0))
    state, observed = world.get_state(), {name: world.observation_space(name) for name in world.agents}
    expected = play(world, 12, np.random.default_rng(1))
    start = world.reset()
    other.reset(seed=77)
    play(other, 3)
    for target in (world, other):
        observations = target.set_state({name: value.copy() for name, value in state.items()})
        assert observations.keys() == observed.keys()
        assert same(play(target, 12, np.random.default_rng(1)), expected)
        assert same(target.reset(), start)


def test_a_failure_is_the_end_for_all(make_game, play, game_name):
    world = make_game(game_name)
    world.reset(seed=0)
    state = world.get_state()
    state["particles.u"][0, 0] = 1e6
    assert set(world.set_state(state)) == set(world.possible_agents)
    [(observations, rewards, terminations, truncations, infos)] = play(world, 1)
    assert all(terminations.values()) and not any(truncations.values()) and not world.agents
    assert all(info["failure"] == "cfl" and not info["success"] for info in infos.values())
    assert all(np.isfinite(row).all() for row in observations.values()) and np.isfinite(list(rewards.values())).all()
    failed = world.get_state()
    world.reset(seed=0)
    assert world.set_state(failed) == {} and world.agents == []


def test_pictures(games, game_name, device, play):
    pytest.importorskip("pyvista")
    module = fresh(games, game_name, device)
    settings = {"render_mode": "rgb_array", "render.width": 64, "render.height": 48}
    world = module.parallel_env(**settings)
    world.reset(seed=0)
    before = world.get_state()
    frames = [world.render()]
    assert all(before[name].tobytes() == value.tobytes() for name, value in world.get_state().items())
    play(world, 5, np.random.default_rng(0))
    frames.append(world.render())
    world.close()
    aec = module.env(**settings)
    frames += official.collect_render_results(aec)
    aec.close()
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 for frame in frames)
    assert min(np.ptp(frame) for frame in frames) > 50
    assert not np.array_equal(frames[0], frames[1]) and not np.array_equal(frames[2], frames[-1])


def test_pettingzoos_render_test(games, game_name, device):
    """Of both modes: pictures are arrays, the live view returns nothing."""
    pytest.importorskip("pyvista")
    pytest.importorskip("viser")
    settings = {"render.width": 64, "render.height": 48}
    official.render_test(functools.partial(fresh(games, game_name, device).env, **settings))


def test_a_world_is_watched(games, game_name, device, play):
    pytest.importorskip("viser")
    world = fresh(games, game_name, device).parallel_env(render_mode="human")
    world.reset(seed=0)
    view = world.host.live.view
    bodies = [f"/world/body_{index}" for index in range(len(world.possible_agents))]
    before = [view._nodes[name].vertices.copy() for name in bodies]
    play(world, 2, np.random.default_rng(0))
    assert world.render() is None
    assert not any(np.array_equal(view._nodes[n].vertices, b) for n, b in zip(bodies, before, strict=True))
    world.close()
    assert view._closed


def test_no_picture_without_a_render_mode(make_game, game_name):
    world = make_game(game_name)
    world.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert world.render() is None


@pytest.mark.parametrize("module", ["piavatar_envs.api.pettingzoo", "piavatar_envs.multi.sumo_v0"])
def test_pettingzoo_is_missing_with_its_remedy(module):
    code = f"""
import sys
sys.modules["pettingzoo"] = None
try:
    import {module}
except ImportError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert "pip install 'piavatar-envs[multi]'" in run.stdout, run.stderr
