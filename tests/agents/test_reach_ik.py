"""The scripted agent reaches every target: the task can be solved, and the observation says how."""

from __future__ import annotations

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
