"""The scripted agent reaches every target: the task can be solved, and the observation says how."""

from __future__ import annotations

import numpy as np

from agents.demo import ReachIK
from agents.evaluate import evaluate, zero_agent
from agents.sb3.config import load_training
from agents.sb3.workers import factory, prepare, start_workers


def test_inverse_kinematics_reaches_every_target(device):
    config = load_training({"env": {"fidelity": "tiny", "episode_seconds": 2.0}, "num_workers": 1})
    make = factory(config)
    facts = prepare(make)
    agent = ReachIK(facts.layout, facts.action_names, facts.action_step, facts.control_dt)
    venv = start_workers(make, 1)
    try:
        scripted = evaluate("scripted", agent, venv, episodes=4, first_seed=0, progress=False)
        still = evaluate("zero", zero_agent(len(facts.action_names)), venv, episodes=4, first_seed=0, progress=False)
    finally:
        venv.close()
    assert scripted.row()["success_at_end"] == 1.0
    assert scripted.row()["failures"] == 0
    assert (scripted.returns > still.returns).all()
    # 60 steps, each worth 1 at most: what is lost is the way there and the cost of control
    assert (scripted.returns > 50.0).all() and (scripted.returns <= 60.0).all()


def test_the_other_arm_is_left_alone(device):
    config = load_training({"env": {"fidelity": "tiny"}, "num_workers": 1})
    make = factory(config)
    facts = prepare(make)
    env = make()
    observation, _ = env.reset(seed=3)
    near_left = observation.copy()
    layout = facts.layout
    near_left[layout["target_from_left_hand"].slice] = [0.05, -0.05, 0.05]
    near_left[layout["target_from_right_hand"].slice] = [0.8, -0.05, 0.05]
    action = ReachIK(layout, facts.action_names, facts.action_step, facts.control_dt)(near_left[None])[0]
    moving = {name.partition(".")[0] for name, value in zip(facts.action_names, action, strict=True) if value != 0.0}
    env.close()
    assert {"left_shoulder", "left_elbow"} <= moving
    assert not any(name.startswith("right_") for name in moving)
    assert np.abs(action).max() <= 1.0
