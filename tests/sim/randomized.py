"""Randomised worlds: ranges, the drawn factors and what follows from them, and the observed parameters."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.envs.parameters import ASSIST, PARAMETERS
from piavatar_envs.sim.randomize import OF_AVATAR, OF_WORLD, Parameter

RANGES = {"mass_factor": (0.5, 1.6), "stiffness_factor": (0.4, 1.5)}
RANGES |= {"ground_friction_factor": (0.25, 1.25), "body_friction_factor": (0.5, 2.0)}
VARIED = {f"randomize.{name}": bounds for name, bounds in RANGES.items()}


def factors_of(batch) -> dict[str, np.ndarray]:
    """Return the drawn factors by setting, of the world ``(num_envs,)`` and of avatars ``(num_envs, avatars)``."""
    random, avatars = batch.simulation.randomization, range(batch.num_agents)
    found = {name: random.column(name).numpy() for name in OF_WORLD}
    return found | {name: np.stack([random.column(name, a).numpy() for a in avatars], 1) for name in OF_AVATAR}


def constants_of(batch, avatar: int = 0) -> dict[str, np.ndarray]:
    """Return the constants that follow from the factors, a row per environment."""
    sim, n = batch.simulation, batch.num_envs
    model, own_avatar = sim.model, sim.avatars[avatar]
    own = slice(own_avatar.body.first, own_avatar.body.first + own_avatar.body.count)
    subject = model.contact.subject.numpy()
    found = {name: getattr(model.particles, name).numpy()[:, own] for name in ("mass", "mu", "lam", "volume")}
    found |= {"bone_mass": own_avatar.body.bone_mass.numpy(), "body_mass": own_avatar.body_mass.numpy()[:, None]}
    found |= {"density": model.contact.density.numpy()[:, subject == avatar]}
    found |= {"ground": model.boundaries.friction.numpy(), "pairs": model.contact.friction.numpy()}
    return {name: np.broadcast_to(array, (n, array.shape[1])).copy() for name, array in found.items()}


def seen(batch) -> np.ndarray:
    """Return the observed term of every environment and agent."""
    return batch.observation.numpy()[:, :, batch.layout[PARAMETERS].slice].copy()


def by_name(batch, agent: int = 0) -> dict[str, np.ndarray]:
    """Return parameters in their units, by name, from what an agent observes."""
    parameters = batch.layout[PARAMETERS].parameters
    return {p.name: p.value(column) for p, column in zip(parameters, seen(batch)[:, agent].T, strict=True)}


def is_setting(parameter: Parameter) -> bool:
    """Return whether it is not drawn, but set for all episodes."""
    return parameter.name.endswith(ASSIST.name)


def check_term(batch, mask: np.ndarray) -> None:
    """Check the term for any task: last in the layout, in range, differs between seeds, as the arrays say, constant."""
    term = batch.layout[PARAMETERS]
    assert list(batch.layout)[-1] == PARAMETERS and term.slice.stop == batch.layout.size
    assert term.size == len(term.parameters) and len({p.name for p in term.parameters}) == term.size
    for p in term.parameters:
        assert p.name in term.description and p.description and p.low < p.high
    first = seen(batch)
    assert (np.abs(first) <= 1.0).all() and (first[..., -1] == -1.0).all() and term.parameters[-1].name == "clock"
    for agent in range(batch.num_agents):
        spread = np.ptp(first[:, agent, :-1], axis=0)
        constant = {p.name for p, s in zip(term.parameters, spread, strict=False) if s == 0.0 and not is_setting(p)}
        assert not constant, f"{constant} do not differ between seeds"
    factors = factors_of(batch)
    for agent in range(batch.num_agents):
        observed = by_name(batch, agent)
        for name in OF_WORLD:
            assert observed[name] == pytest.approx(factors[name], rel=1e-5)
        for index in range(batch.num_agents):
            other = (agent + index) % batch.num_agents
            prefix = f"other_{index - 1}_" if index else ""
            for name in OF_AVATAR:
                assert observed[prefix + name] == pytest.approx(factors[name][:, other], rel=1e-5)
            flesh = batch.simulation.flesh[other]
            for name, value in zip(flesh.asset.shape_names, flesh.shape_parameters.T, strict=True):
                assert observed[f"{prefix}shape_{name}"] == pytest.approx(value, abs=1e-6)
        for p, drawn in zip(batch.task.drawn(), batch.task.drawn_values(batch), strict=True):
            values = drawn.scale * drawn.values.numpy()
            assert (values >= p.low - 1e-5).all() and (values <= p.high * (1 + 1e-5) + 1e-5).all(), p.name
            if p.low < p.high:
                assert observed[p.name] == pytest.approx(values, rel=1e-4, abs=1e-5 * (p.high - p.low)), p.name
    batch.action.zero_()
    for step in range(3):
        batch.step()
        now = seen(batch)
        assert np.array_equal(now[..., :-1], first[..., :-1])
        assert now[..., -1] == pytest.approx(2.0 * (step + 1) / batch.max_steps - 1.0, abs=1e-6)
    batch.reset(env_mask=mask)
    after = seen(batch)
    assert np.array_equal(after[~mask], now[~mask]) and (after[mask][..., -1] == -1.0).all()
    drawn = [not is_setting(p) for p in term.parameters]
    assert (after[mask] != now[mask])[..., drawn].mean() > 0.9, "an environment that was reset must draw anew"
