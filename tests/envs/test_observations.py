"""An avatar's own observation against NumPy in double precision, from the particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES, NUM_JOINTS, PARENTS
from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.envs.observations import (
    CONTACT_TERMS,
    JOINT_TERMS,
    SELF_TERMS,
    ObservationLayout,
    ObservationTerm,
    prop_terms,
)


def kabsch(x: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Return the proper rotation that takes centred points ``x0`` closest to centred ``x``, by NumPy's SVD."""
    U, _, Vt = np.linalg.svd((x - x.mean(0)).T @ (x0 - x0.mean(0)))
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def von_mises(F: np.ndarray, young: float, poisson: float) -> np.ndarray:
    """Return the von Mises stress of a neo-Hookean solid with the stress ``(mu (F F^T - I) + lam ln J I) / J`` [Pa]."""
    mu, lam = young / (2 + 2 * poisson), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    J = np.linalg.det(F)[:, None, None]
    sigma = (mu * (F @ F.transpose(0, 2, 1) - np.eye(3)) + lam * np.log(J) * np.eye(3)) / J
    s = [sigma[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))]
    normal = (s[0] - s[1]) ** 2 + (s[1] - s[2]) ** 2 + (s[2] - s[0]) ** 2
    return np.sqrt(0.5 * normal + 3.0 * (s[3] ** 2 + s[4] ** 2 + s[5] ** 2))


@dataclass(frozen=True)
class Bones:
    """World rotations ``(22, 3, 3)``, joint positions and velocities ``(22, 3)``."""

    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray


def bones_of(batch, env: int = 0) -> Bones:
    simulation = batch.simulation
    points = simulation.flesh[0].points
    own = slice(0, points.num_points)  # props come after the avatar
    state = {k: v[env].astype(float)[own] for k, v in simulation.state.numpy().items() if v.ndim > 1}
    rest, joints = (a[min(env, len(a) - 1)].astype(float) for a in (points.rest, points.joints))
    found = []
    for b in range(NUM_JOINTS):
        p = points.bone == b
        R = kabsch(state["x"][p], rest[p])
        joint = state["x"][p].mean(0) + R @ (joints[b] - rest[p].mean(0))
        found.append((R, joint, (state["u"] + state["vk"])[p].mean(0)))
    return Bones(*(np.array(column) for column in zip(*found, strict=True)))


def observed(batch, env: int = 0) -> dict[str, np.ndarray]:
    """Compute the terms of ``SELF_TERMS`` from the particles."""
    bones, physics = bones_of(batch, env), batch.config.physics
    to_root = bones.rotation[0].T
    local = [bones.rotation[PARENTS[b]].T @ bones.rotation[b] for b in range(1, NUM_JOINTS)]
    F = matrices_of(batch.simulation.state.F)[env, : batch.simulation.avatar.num_points].astype(float)
    stress = von_mises(F, physics.young_modulus, physics.poisson_ratio)
    owner = [JOINT_NAMES[j] for j in batch.simulation.flesh[0].points.skin_joints[:, 0]]
    return {
        "root_height": bones.position[0, 2:],
        "root_orientation": bones.rotation[0, :, :2].T.ravel(),
        "joint_rotations": np.concatenate([R[:, :2].T.ravel() for R in local]),
        "bone_positions": ((bones.position[1:] - bones.position[0]) @ to_root.T).ravel(),
        "bone_velocities": (bones.velocity @ to_root.T).ravel(),
        "stress": np.array([stress[[j in part for j in owner]].max() for part in BODY_PARTS.values()])
        / physics.young_modulus,
    }


#: Differences that single precision and the kernel's SVD may make.
TOLERANCE = {"joint_rotations": 3e-5, "root_orientation": 3e-5, "bone_velocities": 2e-5, "stress": 2e-5}


@pytest.mark.parametrize("settings", [{}, {"shape.randomize": True, "density": 900.0}], ids=str)
def test_values_are_those_of_the_particles(make_batch, sample_id, settings):
    batch = make_batch(sample_id, 2, **settings)
    batch.reset(seeds=[5, 9])
    rng = np.random.default_rng(0)
    # commanded motion hardly strains the flesh: this does
    strain = batch.simulation.state.F.numpy() + rng.normal(0.0, 0.05, batch.simulation.state.F.shape)
    batch.simulation.state.F.assign(strain.astype(np.float32))
    batch.observe_graph.run()
    for step in range(9):
        for env in range(2):
            vector = batch.observation.numpy()[env, 0]
            for name, expected in observed(batch, env).items():
                got = vector[batch.layout[name].slice]
                assert got.shape == expected.shape, name
                error = np.abs(got - expected).max()
                assert error <= TOLERANCE.get(name, 5e-6), f"{name} of environment {env} after {step} steps: {error}"
        batch.action.assign(rng.uniform(-1.0, 1.0, batch.action.shape).astype(np.float32))
        batch.step()
    stress = batch.layout["stress"].slice
    assert (batch.observation.numpy()[:, 0, stress] > 1e-3).all(), "the case must strain the bodies"


def test_stress_is_that_of_the_configured_material(make_batch):
    """Compare a stretched fixed-corotated body with the closed form ``tau = 2 mu (F - I) F^T + lam (J - 1) J``."""
    batch = make_batch("PIAvatar/Reach-v0", 1, material="fixed_corotated", young_modulus=2.0e4, poisson_ratio=0.4)
    batch.reset(seeds=[0])
    stretch = np.diag([1.1, 1.0, 0.95])
    F = batch.simulation.state.F
    F.assign(np.broadcast_to(stretch.reshape(9, 1), F.shape).astype(np.float32))
    batch.observe_graph.run()
    mu, J = 2.0e4 / 2.8, np.linalg.det(stretch)
    sigma = 2.0 * mu * (stretch - np.eye(3)) @ stretch / J  # the volumetric part has no deviator
    deviator = sigma - np.trace(sigma) / 3.0 * np.eye(3)
    expected = np.sqrt(1.5 * (deviator**2).sum()) / 2.0e4
    stress = batch.observation.numpy()[0, 0, batch.layout["stress"].slice]
    assert stress == pytest.approx(np.full(len(BODY_PARTS), expected), rel=1e-4)


def test_layout_tiles_the_vector_and_explains_it(make_env, env_id):
    env = make_env(env_id)
    layout, at = env.observation_layout, 0
    for name, term in layout.items():
        assert term.name == name and term.slice == slice(at, at + term.size) and term.size > 0
        assert term.unit and term.description and term.frame in ("world", "root", "parent", "bone", "-")
        at += term.size
    assert at == layout.size == env.observation_space.shape[0] == env.reset(seed=0)[0].size
    assert list(layout)[: len(SELF_TERMS)] == [term.name for term in SELF_TERMS]
    task = env.batch.task
    seen = [term.name for term in CONTACT_TERMS] if task.observes_contact else []
    seen += [term.name for term in JOINT_TERMS] if task.config.control.mode != "pose" else []
    seen += [term.name for prop in task.observed_props() for term in prop_terms(prop)]
    assert list(layout)[len(SELF_TERMS) :] == seen + [term.name for term in task.terms()]


def test_splitting_copies_along_the_last_axis():
    layout = ObservationLayout([ObservationTerm("a", 2, "m", "world", "x"), ObservationTerm("b", 3, "m", "world", "y")])
    flat = np.arange(10.0).reshape(2, 5)
    parts = layout.split(flat)
    assert parts["a"].tolist() == [[0, 1], [5, 6]] and parts["b"].tolist() == [[2, 3, 4], [7, 8, 9]]
    parts["a"][:] = -1.0
    assert flat[0, 0] == 0.0


def test_a_name_used_twice_is_refused():
    term = ObservationTerm("a", 2, "m", "world", "x")
    with pytest.raises(ValueError, match="'a' occurs twice"):
        ObservationLayout([term, term])


def test_observing_changes_nothing(make_env, env_id):
    batch = make_env(env_id).batch
    batch.reset(seeds=[0])
    batch.step()
    state, observation = batch.get_state(), batch.observation.numpy().copy()
    batch.observation.fill_(np.nan)  # poisoned: every component must be written
    batch.observe_graph.run()
    assert np.array_equal(batch.observation.numpy(), observation)
    assert all(state[name].tobytes() == value.tobytes() for name, value in batch.get_state().items())
