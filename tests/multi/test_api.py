"""Contract of games of several agents: PettingZoo's own tests, determinism, agents that leave, refusals, copies.

Behaviour that depends on the game is tested on every one; that of the shared view, on one of them.
"""

from __future__ import annotations

import copy
import functools
import importlib
import pickle
import subprocess
import sys
import types
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pettingzoo.test as official
import pytest

from piavatar_envs.mpm.types import FAILURE_CFL
from piavatar_envs.multi import listed_games, load_game
from piavatar_envs.tasks.games import game_modules
from tests.api.runs import bytes_of
from tests.conftest import reward_terms
from tests.tasks.measured import assert_all_is_seen

GAME = "sumo_v0"

#: PettingZoo's complaints that are wanted: these observations have no honest limits.
UNBOUNDED = r"Agent's (minimum|maximum) observation space value is -?infinity.*"

#: Terms that need a touch, an agent that leaves or a pass to change; they are tested where that happens.
RARE = ("contact_impulse", "others_in", "passer", "touched", "ball_travel")


@pytest.fixture
def fresh(games, device):
    """Return a game's module with quick settings, as PettingZoo's tests want it; wrappers of the AEC view included."""

    def make(name: str, **settings) -> types.SimpleNamespace:
        settings, module = {"fidelity": "tiny", "device": device, **settings}, games[name]
        return types.SimpleNamespace(
            parallel_env=functools.partial(module.parallel_env, **settings),
            env=functools.partial(module.env, **settings),
        )

    return make


def test_games_are_found():
    assert {"sumo_v0", "boxing_v0"} <= set(listed_games()) and set(game_modules()) <= set(listed_games())
    assert load_game("sumo_v0").TASK is importlib.import_module("piavatar_envs.multi.sumo_v0").TASK
    with pytest.raises(ValueError, match=r"'sumo_v9'.* sumo_v0"):
        load_game("sumo_v9")
    with pytest.raises(ValueError, match=r"PIAvatar/Reach-v0"):
        load_game("raech", ["PIAvatar/Reach-v0"])


def test_listing_is_light_and_a_missing_pettingzoo_is_named():
    code = """
import sys
from piavatar_envs.multi import listed_games
assert listed_games()
print([name for name in ("warp", "torch", "viser") if name in sys.modules])
for name in list(sys.modules):
    if name.startswith(("pettingzoo", "piavatar_envs")):
        del sys.modules[name]
sys.modules["pettingzoo"] = None
import warnings
warnings.simplefilter("ignore")  # Gymnasium warns of ids that are registered again
try:
    from piavatar_envs.multi import sumo_v0
    sumo_v0.parallel_env()
except ImportError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    loaded, error = run.stdout.strip().split("\n")
    assert loaded == "[]" and f'pip install -e "{Path(__file__).parents[2]}[multi]"' in error, run.stdout + run.stderr


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="PettingZoo has had a registry since 1.27")
def test_pettingzoos_registry_has_the_games(fresh, device):
    assert {f"piavatar/{name.replace('_v', '-v')}" for name in game_modules()} <= set(pettingzoo.parallel_registry)
    settings = {"fidelity": "tiny", "device": device, "max_cycles": 2}
    parallel, aec = (pettingzoo.make(kind, f"piavatar/{GAME}", **settings) for kind in ("parallel", "aec"))
    assert parallel.metadata["name"] == aec.metadata["name"] == GAME and parallel.host.groups[0].max_steps == 2


def test_pettingzoos_tests_pass(fresh, game_name, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", UNBOUNDED)
        official.parallel_api_test(fresh(game_name).parallel_env(max_cycles=12), num_cycles=15)
        official.api_test(fresh(game_name).env(max_cycles=8), num_cycles=30)
    passed = capsys.readouterr().out
    assert "Passed Parallel API test" in passed and "Passed API test" in passed


def test_pettingzoos_tests_of_seeds_and_clocks_pass(fresh):
    module = fresh(GAME)
    official.seed_test(module.env, num_cycles=5)
    official.parallel_seed_test(module.parallel_env, num_cycles=2)
    official.max_cycles_test(module)


def test_seeds_and_states_repeat_a_run(make_game, play, same, game_name):
    """The same seed repeats a run over two episodes, in another environment too; so does a state from within one."""
    runs, states = [], []
    for game in (make_game(game_name), make_game(game_name, twin=1), make_game(game_name)):
        game.reset(seed=9)
        first = [game.reset(seed=5), *play(game, 8, np.random.default_rng(0)), game.reset()]
        play(game, 2, np.random.default_rng(1))
        states.append({name: value.copy() for name, value in game.get_state().items()})
        runs.append([first, play(game, 6, np.random.default_rng(2)), game.reset()])
    assert same(runs[0], runs[1]) and same(runs[0], runs[2])
    game.reset(seed=77)
    play(game, 3)
    assert game.set_state(states[0]).keys() == set(game.possible_agents)
    assert same([play(game, 6, np.random.default_rng(2)), game.reset()], runs[0][1:])


def test_seeds_episodes_and_agents_differ(make_game, fresh, game_name):
    game = make_game(game_name)
    starts = {f"seed {seed}": game.reset(seed=seed)[0] for seed in (0, 1)}
    starts |= {"second episode": game.reset()[0]}
    starts |= {f"unseeded {n}": fresh(game_name).parallel_env().reset()[0] for n in (0, 1)}
    names = list(starts)
    for i, a in enumerate(names):
        for b in names[:i]:
            for agent in game.possible_agents:
                assert np.abs(starts[a][agent] - starts[b][agent]).max() > 1e-4, f"{a} is {b} for {agent}"
    joints = game.observation_layout["joint_rotations"].slice
    first, *others = (observation[joints] for observation in starts["seed 0"].values())
    assert all(np.abs(other - first).max() > 1e-3 for other in others)


@pytest.mark.parametrize("kind", ["uniform", "corners", "held corners"])
def test_answers_under_full_actions_keep_the_contract(make_game, game_name, kind):
    """All numbers are finite, in their spaces and of their types; rewards are the sums of their terms."""
    game, rng, task = make_game(game_name), np.random.default_rng(0), make_game(game_name).batch.task
    _, infos = game.reset(seed=0)
    keys = set(infos["agent_0"])
    assert set(infos) == set(game.possible_agents) and all(info["failure"] == 0 for info in infos.values())
    size, actions, seen = game.action_space("agent_0").shape, {}, {name: [] for name in game.possible_agents}
    for step in range(25):
        if not game.agents or (kind == "uniform" and step % 9 == 8):
            game.reset()
        for name in game.possible_agents:
            if kind == "uniform":
                actions[name] = rng.uniform(-1.0, 1.0, size)
            elif kind == "corners" or step % 8 == 0:
                actions[name] = rng.choice([-1.0, 1.0], size)
        observations, rewards, terminations, truncations, infos = game.step({n: actions[n] for n in game.agents})
        assert infos.keys() == observations.keys() == rewards.keys() == terminations.keys() == truncations.keys()
        for name, info in infos.items():
            assert info["failure"] == 0, f"step {step}: {info['failure']}"
            assert game.observation_space(name).contains(observations[name]) and np.isfinite(observations[name]).all()
            seen[name].append(observations[name])
            flags = terminations[name], truncations[name], info["success"], info["root_released"]
            assert type(rewards[name]) is float and all(type(flag) is bool for flag in flags)
            terms = reward_terms(info)
            assert set(info) == keys
            assert tuple(terms) == task.reward_names and np.isfinite(list(terms.values())).all()
            assert rewards[name] == pytest.approx(sum(terms.values()), abs=1e-5)
            assert all(np.isfinite(info[metric]) for metric in task.metric_names)
            assert info["root_force"].shape == info["root_torque"].shape == (3,)
            assert ("cost" in info) == bool(task.cost_names)
    for name, rows in seen.items():
        for term in game.observation_layout.values():
            spread = np.ptp(np.array(rows)[:, term.slice], axis=0)
            changes = term.name in RARE or (spread > 0.0).mean() > 0.5
            assert changes or kind != "uniform", f"{name}: {term.name} never changes"


def test_a_failure_is_the_end_for_all(make_game, play, game_name):
    game = make_game(game_name)
    game.reset(seed=0)
    state = game.get_state()
    state["particles.u"][0, 0] = 1e6
    assert set(game.set_state(state)) == set(game.possible_agents)
    [(observations, rewards, terminations, truncations, infos)] = play(game, 1)
    assert all(terminations.values()) and not any(truncations.values()) and not game.agents
    assert all(info["failure"] == FAILURE_CFL and not info["success"] for info in infos.values())
    assert all(np.isfinite(row).all() for row in observations.values())
    assert max(np.abs(list(rewards.values()))) < 1.0, "no agent is at fault"
    failed = game.get_state()
    game.reset(seed=0)
    assert game.set_state(failed) == {} and game.agents == []


@pytest.mark.parametrize("seed", [-1, 2**32, "one", 1.5])
def test_seeds_of_another_kind_are_refused(make_game, seed):
    with pytest.raises((ValueError, gymnasium.error.Error)):
        make_game(GAME).reset(seed=seed)


def test_a_copy_goes_on_as_the_original(make_game, play, same):
    """Over the end of the episode; also where an agent has left, and where all agents have left."""
    game = make_game(GAME, max_cycles=5)
    assert copy.deepcopy(game).agents == game.agents
    for steps, make_copy in ((2, copy.deepcopy), (3, lambda env: pickle.loads(pickle.dumps(env))), (5, copy.deepcopy)):
        game.reset(seed=3)
        play(game, steps, np.random.default_rng(0))
        if steps == 3:
            state = game.get_state()
            state["env.alive"][0, 0], state["env.terminated"][0, 0] = False, True
            game.set_state(state)
        runs, copied = [], make_copy(game)
        for env in (game, copied):
            rng = np.random.default_rng(1)
            runs.append([env.agents, play(env, 6, rng), env.agents, env.reset(), env.agents, play(env, 6, rng)])
        assert same(runs[0], runs[1])


def test_copies_of_the_aec_view_and_of_a_new_environment(fresh, same):
    for other in (copy.deepcopy(new := fresh(GAME).parallel_env()), pickle.loads(pickle.dumps(new))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            other.step({})
        assert other.reset(seed=1) and other.agents == other.possible_agents
    env = fresh(GAME).env(max_cycles=3)
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


def test_spaces_metadata_and_state(make_game, play):
    game = make_game(GAME)
    spaces = (game.action_spaces, game.action_space), (game.observation_spaces, game.observation_space)
    for by_name, space in spaces:
        assert all(space(name) is space(name) is by_name[name] for name in game.possible_agents)
        assert len({id(space) for space in by_name.values()}) == len(game.possible_agents)
    assert len(game.action_names) == game.action_space("agent_0").shape[0]
    assert game.metadata["name"] == GAME == str(game) and game.metadata["is_parallelizable"]
    assert game.metadata["render_fps"] == 30 and make_game(GAME, control_dt=0.02).metadata["render_fps"] == 50
    observations, _ = game.reset(seed=0)
    before = game.state()
    assert np.array_equal(before, np.concatenate([observations[name] for name in game.possible_agents]))
    assert game.state_space.contains(before)
    play(game, 2)
    assert not np.array_equal(before, game.state())


def test_a_dictionary_is_the_flat_vector_by_name(make_game, play, same):
    flat, named = make_game(GAME), make_game(GAME, obs_mode="dict")
    rows = [(env.reset(seed=8), *play(env, 3, np.random.default_rng(1))) for env in (flat, named)]
    for (vectors, *_), (terms, *_) in zip(*rows, strict=True):
        for name, vector in vectors.items():
            assert named.observation_space(name).contains(terms[name])
            assert same(flat.observation_layout.split(vector), terms[name])
    assert same(flat.state(), named.state())


def test_every_agent_acts_and_is_measured_by_itself(make_game):
    game = make_game(GAME)
    first, second = game.possible_agents
    game.reset(seed=0)
    actions = {name: np.zeros(game.action_space(name).shape) for name in game.agents}
    actions[second] += 1.0
    infos = game.step(actions)[4]
    assert infos[first]["reward_control"] == 0.0 > infos[second]["reward_control"]
    assert not np.allclose(infos[first]["root_force"], infos[second]["root_force"], rtol=1e-3)
    for name, avatar in zip(game.possible_agents, game.batch.simulation.avatars, strict=True):
        assert np.array_equal(infos[name]["root_force"], avatar.state.wrench_force.numpy()[0])


def arrays_in(value) -> list[np.ndarray]:
    if isinstance(value, dict):
        return [array for item in value.values() for array in arrays_in(item)]
    if isinstance(value, (tuple, list)):
        return [array for item in value for array in arrays_in(item)]
    return [value] if isinstance(value, np.ndarray) and value.ndim else []


def test_arrays_belong_to_the_caller(make_game, play, same):
    """Those that are returned are copies, and actions are not written to."""
    game = make_game(GAME)
    internal = [array.numpy() for array in (*game.batch.arrays().values(), game.batch.observation)]
    returned = arrays_in([game.reset(seed=1), *play(game, 3), game.state(), game.set_state(game.get_state())])
    for i, a in enumerate(returned):
        assert a.flags.writeable and not any(np.shares_memory(a, b) for b in (*returned[:i], *internal))
    untouched = [game.reset(seed=1), *play(game, 3)]
    for array in arrays_in([game.reset(seed=1)]):
        array[:] = np.nan
    assert same([row[0] for row in untouched[1:]], [row[0] for row in play(game, 3)])
    actions = {name: np.full(game.action_space(name).shape, 3.0, np.float32) for name in game.agents}
    game.step(actions)
    assert all((action == 3.0).all() for action in actions.values())


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda actions: {"agent_0": actions["agent_0"]}, "agent_1; .* agent_0, "),
        (lambda actions: {}, "agent_0, agent_1"),
        (lambda actions: actions | {"agent_99": actions["agent_0"]}, "agent_99; .* agent_0, agent_1"),
        (lambda actions: actions | {"agent_1": np.zeros(3)}, r"agent_1: .*\(3,\)"),
        (lambda actions: actions | {"agent_1": actions["agent_1"] * np.nan}, r"agent_1: action\[0\].* nan"),
        (lambda actions: actions | {"agent_1": None}, "agent_1: .*shape"),
        (lambda actions: list(actions.values()), "list; .*agent_0, agent_1"),
    ],
    ids=["missing", "empty", "unknown", "shape", "nan", "none", "list"],
)
def test_bad_actions_are_refused_before_anything_changes(make_game, spoil, reason):
    game = make_game(GAME)
    game.reset(seed=0)
    before, state = game.get_state(), game.state()
    with pytest.raises(ValueError, match=reason):
        game.step(spoil({name: np.zeros(game.action_space(name).shape) for name in game.agents}))
    after = game.get_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    assert np.array_equal(game.state(), state) and game.agents == game.possible_agents


def test_nothing_goes_before_the_first_reset_or_after_the_end(fresh, play):
    game = fresh(GAME).parallel_env(max_cycles=2, render_mode="rgb_array")
    assert game.agents == []
    for call in (lambda: game.step({}), game.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()
    game.reset(seed=0)
    truncations = [row[3] for row in play(game, 5)]
    assert len(truncations) == 2 and all(truncations[1].values()) and not any(truncations[0].values())
    assert game.agents == []
    before = bytes_of(game.get_state())
    assert game.step({}) == ({}, {}, {}, {}, {}) and bytes_of(game.get_state()) == before
    with pytest.raises(gymnasium.error.ResetNeeded):
        game.step({"agent_0": game.action_space("agent_0").sample()})
    game.reset()
    assert game.agents == game.possible_agents


@pytest.mark.parametrize(
    ("game_name", "settings", "reason"),
    [
        (GAME, {"max_cycles": 0}, "max_cycles=0 "),
        (GAME, {"max_cycles": 1.5}, "max_cycles=1.5 "),
        (GAME, {"render_mode": "ansi"}, "render_mode='ansi' .*rgb_array"),
        (GAME, {"bogus": 1}, "bogus "),
        (GAME, {"device": "tpu"}, "device='tpu'"),
        (GAME, {"scene": {"avatars": [{"yaw": 0.0}] * 9}}, "scene.avatars .* 9 "),
        (GAME, {"num_agents": 8}, r"num_agents=8 .* ring_radius >= 1.7"),
        (GAME, {"num_agents": 0}, "num_agents=0 .* 1"),
        (GAME, {"joints": ["tail"]}, "'tail'"),
        ("boxing_v0", {"num_agents": 8}, r"num_agents=8 .* ring_size >= 3.5"),
        ("high_five_v0", {"impulse": (0.0, 1.0)}, "impulse.* positive"),
        ("high_five_v0", {"impulse": (2.0, 1.0)}, "impulse.* positive"),
        ("pass_ball_v0", {"ball_mass": (0.0, 1.0)}, "ball_mass.* (positive|0.001)"),
        ("pass_ball_v0", {"serve_speed": (2.0, 1.0)}, "serve_speed=.* positive"),
    ],
)
def test_settings_that_cannot_be_are_refused(fresh, game_name, settings, reason):
    with pytest.raises(ValueError, match=reason):
        fresh(game_name).parallel_env(**settings)


def test_max_cycles_wins_over_episode_seconds(fresh):
    assert fresh(GAME).parallel_env(max_cycles=7, episode_seconds=3.0).batch.max_steps == 7
    assert fresh(GAME).parallel_env(episode_seconds=3.0).batch.max_steps == 90


def test_pictures_show_every_game_and_change_nothing(fresh, game_name, play):
    small = {"render.width": 64, "render.height": 48}
    game = fresh(game_name).parallel_env(render_mode="rgb_array", **small)
    game.reset(seed=0)
    before = game.get_state()
    frames = [game.render()]
    assert all(before[name].tobytes() == value.tobytes() for name, value in game.get_state().items())
    play(game, 5, np.random.default_rng(0))
    frames.append(game.render())
    game.close()
    assert all(frame.shape == (48, 64, 3) and frame.dtype == np.uint8 and np.ptp(frame) > 50 for frame in frames)
    assert not np.array_equal(*frames)


def test_a_game_is_watched_and_pettingzoos_render_test_passes(fresh, play):
    pytest.importorskip("viser")
    official.render_test(functools.partial(fresh(GAME).env, **{"render.width": 64, "render.height": 48}))
    game = fresh(GAME).parallel_env(render_mode="human")
    game.reset(seed=0)
    view = game.host.live.view
    # a band of one colour of each
    bodies = [f"/world/body_{index}_band_0" for index in range(len(game.possible_agents))]
    before = [view._nodes[name].vertices.copy() for name in bodies]
    play(game, 2, np.random.default_rng(0))
    assert game.render() is None
    assert not any(np.array_equal(view._nodes[n].vertices, b) for n, b in zip(bodies, before, strict=True))
    game.close()
    assert view.closed


def test_no_picture_without_a_render_mode(make_game):
    make_game(GAME).reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert make_game(GAME).render() is None


def test_a_new_episode_is_all_in_the_picture(make_game, game_name):
    assert_all_is_seen(make_game(game_name))
