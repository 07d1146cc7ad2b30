"""Settings that change while a world runs: against free fall, sliding, and worlds that were built with them."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.sim.throws import Thrower
from piavatar_envs.sim.tuning import ALPHA, FRICTION, GRAVITY, STIFFNESS, TONE
from piavatar_envs.tasks import load_task

BALL = {"name": "ball", "size": [0.12], "mass": 1.0, "position": [0.0, -1.2, 1.8], "top_speed": 8.0}


def batch(device: str, **settings) -> BatchEnv:
    kind = load_task("Reach-v0")
    env = BatchEnv(kind(load_config(kind.Config, None, {"fidelity": "tiny", **settings})), 2, device)
    _ = env.tuning
    env.reset(seeds=[0, 1])
    return env


def test_a_world_that_was_tuned_is_one_that_was_built_so(device):
    """Change friction, tone, alpha and stiffness before the first step: the states are those of another world."""
    values = {STIFFNESS: 4.0e4, FRICTION: 0.2, TONE: 0.4, ALPHA: 0.7}
    # as many substeps as stiffer flesh needs, each damping short waves
    step = {"num_substeps": 12, "reference_substeps": 12}
    tuned, built, left = batch(device, **step), batch(device, **step, **values), batch(device, **step)
    tuned.tune(values)
    for env in (tuned, built, left):
        env.action.fill_(0.6)
        for _ in range(5):
            env.step()

    def apart(first: BatchEnv, second: BatchEnv) -> float:
        return float(np.sqrt(np.mean((first.simulation.state.x.numpy() - second.simulation.state.x.numpy()) ** 2)))

    # moduli are rounded twice
    assert apart(tuned, built) < 0.02 * apart(left, built)


def test_gravity_acts_from_the_next_step_on(device):
    env = batch(device, **{"scene.props": [BALL]})
    env.tune({GRAVITY: 3.0})
    velocity = env.simulation.props.state.velocity
    for _ in range(3):
        env.step()
    assert velocity.numpy()[:, 0, 2] == pytest.approx(-3.0 * 3 / 30.0, rel=1e-3)
    env.tune({GRAVITY: 9.81})
    env.step()
    assert velocity.numpy()[:, 0, 2] == pytest.approx(-0.3 - 9.81 / 30.0, rel=1e-3)


def test_what_needs_another_world_is_refused(device):
    env = batch(device, **{"scene.props": [BALL]})
    before = dict(env.tuning.values)
    for values, words in (
        ({TONE: 0.2, STIFFNESS: 2.0e5}, "shorter time step"),
        ({TONE: 0.2, GRAVITY: 20.0}, "props that fall faster"),
    ):
        with pytest.raises(ValueError, match=words):
            env.tune(values)
    with pytest.raises(ConfigError, match=r"control\.tone=2"):
        env.tune({TONE: 2.0})
    assert env.tuning.values == before
    random = batch(device, **{"randomize.stiffness_factor": [0.5, 1.0], "randomize.ground_friction_factor": [0.5, 1.0]})
    for name in (STIFFNESS, FRICTION):
        assert "every episode draws" in random.tuning.refusal(name, 0.1)
    torque = batch(device, control="torque")
    assert "has no tone" in torque.tuning.refusal(TONE, 0.1) and TONE not in torque.tuning.values


def test_a_throw_places_one_ball_of_one_environment(device):
    env = batch(device, **{"scene.props": [BALL]})
    thrower = Thrower(env.simulation, "ball")
    env.step()
    state, matter = env.simulation.props.state, env.simulation.model.particles.mass
    ball = env.simulation.props.props[0]
    other = state.position.numpy()[0, 0].copy()
    thrower.throw(1, (0.4, -1.0, 1.0), (1.0, 0.0, 2.0), 2.5)
    np.testing.assert_allclose(state.position.numpy()[1, 0], (0.4, -1.0, 1.0), atol=1e-5)
    np.testing.assert_allclose(state.velocity.numpy()[1, 0], (1.0, 0.0, 2.0), atol=1e-5)
    np.testing.assert_array_equal(state.position.numpy()[0, 0], other)
    masses = matter.numpy()[:, ball.first : ball.first + ball.count].sum(axis=1)
    np.testing.assert_allclose(masses, (1.0, 2.5), rtol=1e-5)
    for _ in range(3):
        env.step()
    np.testing.assert_allclose(state.velocity.numpy()[1, 0], (1.0, 0.0, 2.0 - 9.81 / 10.0), atol=5e-3)
    assert not env.failure.numpy().any()
