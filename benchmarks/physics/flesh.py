"""Checks of the flesh against theory: it does not wear out, and bent joints keep its volume and their ranges."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium
import numpy as np
from scipy.spatial import Delaunay

from agents.files import ROOT
from benchmarks.physics.checks import Options, Quantity, SimulationFailed, at_least, at_most, check, equal
from benchmarks.physics.probe import EMPTY, Measurements, Probe, empty
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_limits
from piavatar_envs.envs.batch_env import BatchEnv

SPIN = 8.0  # of a whole body [rad/s]
PROP_SPIN = 20.0  # of a ball [rad/s]
SWING_RATE, SWING = 1.0, 0.5  # frequency of legs [Hz], and amplitude as a share of the actions
TRUNK = ("pelvis", "spine1", "spine2", "spine3")
WAIST = (1.0, 1.14)  # height of the waist at rest [m]
LONGEST_EDGE, LEAST_VOLUME = 0.06, 2.0e-7  # of tetrahedra between particles of the trunk [m], [m^3]
POLICIES = {"stand": "ppo/stand_0", "walk": "ppo/walk_0"}


def swing_legs(env: BatchEnv, seconds: float, start: float = 0.0) -> None:
    """Swing hips and knees of a body under ``pd`` control against each other, from time ``start`` on."""
    index, step = env.action_spec.names().index, env.config.physics.control_dt
    for n in range(round(seconds / step)):
        phase = np.sin(2.0 * np.pi * SWING_RATE * (start + n * step))
        action = np.zeros(env.action.shape, np.float32)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            action[..., index(f"{side}_hip.x")] = SWING * sign * phase
            action[..., index(f"{side}_knee.x")] = 0.25 * SWING * (1.0 + sign * phase)
        env.action.assign(action)
        env.step()


def set_spinning(env: BatchEnv, rate: float) -> None:
    """Set a spin of the whole body about the vertical through its centre of mass [rad/s]."""
    state, model = env.simulation.state, env.simulation.model
    x, mass = state.x.numpy()[0].astype(float), model.particles.mass.numpy()[0].astype(float)
    state.u.assign(np.cross((0.0, 0.0, rate), x - mass @ x / mass.sum())[None].astype(np.float32))
    C = np.zeros((9, 1), np.float32)
    C[1], C[3] = -rate, rate
    state.C.assign(np.broadcast_to(C, state.C.shape).copy())


@check("wear_swing", "legs swing at 1 Hz, pelvis held, no contact (pd)")
def wear_swing(options: Options) -> Iterator[Quantity]:
    """Swing the legs in empty space, then let them rest for two seconds; inertia strains flesh by 0.0005."""
    probe = Probe.under(options, "pd", **EMPTY)
    swing_legs(probe.batch, options.seconds)
    yield at_most(f"mean strain after {options.seconds:g} s", probe.strain().mean(), 0.002, theory=0.0005)
    probe.run(2.0)
    yield at_most("elastic energy left at rest", probe.elastic_energy(probe.body), 0.1, "J", theory=0.0)
    yield at_most("flesh off its place at rest, mean", 1e3 * probe.displacement().mean(), 0.5, "mm", theory=0.0)


@check("wear_spin", "free body spins at 8 rad/s, no contact (pd)")
def wear_spin(options: Options) -> Iterator[Quantity]:
    """Spin a whole body; its inertia strains it by 0.0016, and no energy goes into flesh after the first second."""
    probe = Probe.under(options, "pd", held=False, **EMPTY)
    set_spinning(probe.batch, SPIN)

    def kinetic() -> float:
        return 0.5 * float(probe.mass @ (probe.velocity**2).sum(1))

    probe.run(1.0)
    early = kinetic()
    probe.run(0.5 * options.seconds - 1.0)
    yield at_most(f"mean strain after {0.5 * options.seconds:g} s", probe.strain().mean(), 0.002, theory=0.0016)
    yield equal("kinetic energy over that after 1 s", kinetic() / early, 1.0, 0.002)


@check("wear_prop", "ball of 1.5 kg spins at 20 rad/s (no avatar near)")
def wear_prop(options: Options) -> Iterator[Quantity]:
    """Spin a ball; once it has given way to its inertia, it neither swells nor slows."""
    prop = {"name": "ball", "mass": 1.5, "size": [0.11], "position": [-1.2, -1.2, 1.2], "spin": [0.0, 0.0, PROP_SPIN]}
    probe = Probe.under(options, "pose", **empty(prop))
    ball = probe.prop()

    def second() -> tuple[float, float]:
        widths, spins = [], []
        for _ in range(round(1.0 / probe.dt)):
            probe.step()
            widths.append(np.sqrt(((probe.x[ball] - probe.center(ball)) ** 2).sum(1).mean()))
            spins.append(probe.simulation.props.state.spin.numpy()[0, 0, 2])
        return float(np.mean(widths)), float(np.mean(spins))

    second()
    early = second()
    probe.run(max(1.0, 0.5 * options.seconds - 3.0))
    late = second()
    yield equal("radius over that in the 2nd second", late[0] / early[0], 1.0, 0.001)
    yield equal("spin over that in the 2nd second", late[1] / early[1], 1.0, 0.002)


def tetrahedra(rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return tetrahedra between neighbouring points ``(T, 4)`` and their volumes [m^3], all positive."""
    corners = Delaunay(rest).simplices
    places, volume = rest[corners], volumes(rest, corners)
    edges = np.linalg.norm(places[:, :, None] - places[:, None], axis=3).max((1, 2))
    kept = (edges < LONGEST_EDGE) & (np.abs(volume) > LEAST_VOLUME)
    corners, volume = corners[kept], volume[kept]
    corners[volume < 0.0] = corners[volume < 0.0][:, [0, 2, 1, 3]]
    return corners, np.abs(volume)


def volumes(x: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the signed volumes of tetrahedra [m^3]."""
    a, b, c, d = (x[corners[:, index]] for index in range(4))
    return np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) / 6.0


def outside_range(probe: Measurements) -> float:
    """Return the distance of the joint that is furthest outside its range from that range [deg]."""
    lower, upper = joint_limits()
    moving = [not name.endswith(("pelvis", "foot")) for name in JOINT_NAMES]  # toes are locked, the pelvis has no range
    excess = np.maximum(probe.local - upper, lower - probe.local)[moving]
    return float(np.degrees(max(0.0, excess.max())))


def policy(options: Options, folder: str, seconds: float = 3.0) -> Iterator[Quantity]:
    """Play a committed policy, and compare the trunk's volume with that at rest by tetrahedra between particles.

    The deformation gradient of the particles does not contain what skinning does to the volume; tetrahedra do.
    """
    from agents.evaluate import begin_round  # only this check needs the extra ``train``
    from agents.play import open_run

    run = open_run(ROOT / "benchmarks" / "results" / folder)
    env = gymnasium.make(run.env_id, config=dict(run.env), device=options.device).unwrapped
    agent = run.make_agent(env.observation_layout, env.action_space.shape[0])
    begin_round(agent, 1)
    probe = Probe(env)
    observation, _ = env.reset(seed=0)
    chosen, outside = probe.particles_of(*TRUNK), 0.0
    rest = probe.points.rest[0][chosen].astype(float)
    corners, before = tetrahedra(rest)
    height = rest[corners].mean(1)[:, 2]
    waist = (height > WAIST[0]) & (height < WAIST[1])
    trunk_ratio, waist_ratio = [], []
    for _ in range(round(seconds / probe.dt)):
        observation, _, terminated, _, _ = env.step(np.asarray(agent(observation[None, None])[0, 0]))
        if terminated:
            raise SimulationFailed("the episode ended")
        now = volumes(probe.x[probe.body][chosen], corners)
        trunk_ratio.append(now.sum() / before.sum())
        waist_ratio.append(now[waist].sum() / before[waist].sum())
        outside = max(outside, outside_range(probe))
    yield at_least("volume of the waist over that at rest, mean", np.mean(waist_ratio), 0.97, theory=1.0)
    yield at_least("volume of the trunk over that at rest, mean", np.mean(trunk_ratio), 0.97, theory=1.0)
    yield at_most("joint furthest outside its range", outside, 1.0, "deg", theory=0.0)


@check("waist_stand", "committed policy of Stand for 3 s")
def waist_stand(options: Options) -> Iterator[Quantity]:
    """Play the committed policy of Stand."""
    yield from policy(options, POLICIES["stand"])


@check("waist_walk", "committed policy of Walk for 3 s")
def waist_walk(options: Options) -> Iterator[Quantity]:
    """Play the committed policy of Walk."""
    yield from policy(options, POLICIES["walk"])


@check("ranges_limp", "limp body falls to the floor (torque)")
def ranges_limp(options: Options) -> Iterator[Quantity]:
    """Let a body without torques fall and lie for three seconds."""
    probe, outside = Probe.under(options, "torque", held=False), 0.0
    for _ in range(round(3.0 / probe.dt)):
        probe.step()
        outside = max(outside, outside_range(probe))
    yield at_most("joint furthest outside its range", outside, 1.0, "deg", theory=0.0)
