"""A dressed avatar that follows a motion, through the environments that users have, and what is measured of it."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.garments.rows import Options
from benchmarks.physics.checks import SimulationFailed
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.skin import Skin

#: Skin deeper than this in cloth counts [m].
DEEP = 1e-3
TRACK = "PIAvatar/TrackMotion-v0"
#: TrackMotion without what disturbs the motion.
UNDISTURBED = {"impulse": 0.0, "random_start": False, "fail_distance": 100.0, "episode_seconds": 5.0}
RATE = 30
#: Spin of the flutter test: rest, acceleration, speed [rev/s], end of the spin, stop and rest [s].
REST, RAMP, SPEED, SPUN, STOP, AFTER = 0.8, 0.5, 2.0, 2.0, 0.2, 1.3

Garments = Sequence[Mapping[str, Any]]


class Dressed:
    """Environments with garments that hold still, or follow their motion.

    Attributes:
        env: of the public API; one environment, or a vector.
        simulation: its physics.
        garments: cloth and surfaces of the simulation.
        mesh: of the cloth.
        time: since the reset [s].
    """

    def __init__(
        self,
        garments: Garments,
        options: Options,
        env_id: str = TRACK,
        num_envs: int = 0,
        seed: int = 0,
        **settings: Any,
    ) -> None:
        """Build and reset.

        Args:
            garments: as ``gymnasium.make`` takes them.
            options: resolution and device.
            env_id: of the environment.
            num_envs: environments of a vector; 0 for a single environment.
            seed: of the reset.
            settings: of the environment.
        """
        given = {"garments": garments, "fidelity": options.fidelity, "device": options.device, **settings}
        given = (UNDISTURBED if env_id == TRACK else {}) | given
        if num_envs:
            mode = {"vectorization_mode": "vector_entry_point", "num_threads": 1}
            self.env: Any = gymnasium.make_vec(env_id, num_envs=num_envs, **mode, **given)
            (batch,) = self.env.unwrapped.host.groups
        else:
            self.env = gymnasium.make(env_id, **given)
            batch = self.env.unwrapped.batch
        self.simulation, self.time = batch.simulation, 0.0
        self.garments = getattr(batch.simulation, "garments", None)
        self.mesh = self.garments.cloth.mesh if self.garments else None
        self._skins: dict[int, Skin] = {}
        self.env.reset(seed=seed)
        self._still = np.zeros(self.env.action_space.shape, np.float32)

    def step(self, count: int = 1) -> Dressed:
        """Take control steps with actions of zero.

        Raises:
            SimulationFailed: the simulation has failed.
        """
        for _ in range(count):
            self.env.step(self._still)
            self.time += 1.0 / RATE
            failure = self.simulation.state.failure.numpy()
            if failure.any():
                raise SimulationFailed(f"failure {failure.tolist()} after {self.time:.2f} s")
        return self

    def get(self, name: str = "x", e: int = 0) -> np.ndarray:
        """Return positions or velocities of the cloth in double precision, shape ``(V, 3)``."""
        return getattr(self.garments.cloth.state, name).numpy()[e].astype(float)

    def impulse(self, e: int = 0) -> np.ndarray:
        """Return the impulse of the cloth on bodies and props in the last control step [N s], shape ``(3,)``."""
        return self.garments.surfaces._receivers.force.numpy()[e].astype(float).sum(axis=0)

    @property
    def mass(self) -> np.ndarray:
        """Masses of the vertices [kg]; 0 where they are held."""
        return self.garments.cloth.mass[0]

    @property
    def held(self) -> np.ndarray:
        """Vertices that are held."""
        return np.flatnonzero(self.mass == 0.0)

    def strain(self, e: int = 0) -> float:
        """Return the root mean square of the edges' strain, by area."""
        cloth, mesh = self.garments.cloth, self.mesh
        length = cloth.length.numpy().astype(float)
        x = self.get("x", e)
        now = np.linalg.norm(x[mesh.edges[:, 0]] - x[mesh.edges[:, 1]], axis=1)
        strain = now / length[min(e, len(length) - 1)] - 1.0
        return float(np.sqrt(np.average(strain**2, weights=mesh.edge_area)))

    def skin(self, e: int = 0) -> np.ndarray:
        """Return the vertices of the deformed skin [m], shape ``(V, 3)``."""
        simulation, avatar = self.simulation, self.simulation.avatar
        flesh = simulation.flesh[0]
        if e not in self._skins:
            varies = flesh.shape.randomize
            parameters = simulation.shapes.parameters(0).numpy()[e] if varies else flesh.base_parameters
            points, _ = flesh.shaped(parameters)
            body = flesh.asset.shape(parameters)
            self._skins[e] = Skin(flesh.asset, body, points.rest[0], points.skin_joints, points.skin_weights)
        tracked = avatar.tracked
        turned = Rotation.from_quat(tracked.rotation.numpy()[e].astype(float)).as_matrix()
        own = slice(avatar.body.first, avatar.body.first + avatar.body.count)
        places = tracked.position.numpy()[e].astype(float), simulation.state.x.numpy()[e, own].astype(float)
        return self._skins[e].deform(turned, *places)

    def deep(self, e: int = 0) -> float:
        """Return the share of the cloth's vertices, edges and triangles that are deeper than 1 mm in the full skin.

        An edge or a triangle is as deep as its middle.
        """
        x = self.get("x", e)
        points = np.concatenate([x, x[self.mesh.edges].mean(axis=1), x[self.mesh.faces].mean(axis=1)])
        skin = ClosedSurface(self.skin(e), self.simulation.flesh[0].asset.faces)
        return float((skin.distance(points) < -DEEP).mean())


def spin_file(folder: str | Path) -> str:
    """Write a person in a T-pose that stands, spins, stops and stands, as an AMASS file, and return its path."""
    time = np.arange(round((REST + SPUN + STOP + AFTER) * RATE) + 1) / RATE - REST
    omega = 2.0 * np.pi * SPEED
    angle = np.where(time < 0.0, 0.0, 0.5 * omega * np.clip(time, 0.0, RAMP) ** 2 / RAMP)
    angle += omega * np.clip(time - RAMP, 0.0, SPUN - RAMP)
    braked = np.clip(time - SPUN, 0.0, STOP)
    angle += omega * (braked - 0.5 * braked**2 / STOP)
    upright = Rotation.from_euler("x", 90.0, degrees=True)
    poses = np.zeros((len(time), 156))
    poses[:, :3] = (Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]) * upright).as_rotvec()
    path = Path(folder) / "spin.npz"
    np.savez(path, poses=poses, trans=np.zeros((len(time), 3)), mocap_framerate=float(RATE))
    return str(path)


def spinning(garments: Garments, options: Options, **settings: Any) -> Dressed:
    """Return an avatar that :func:`spin_file` moves, before it spins."""
    with tempfile.TemporaryDirectory() as folder:
        return Dressed(garments, options, motion=spin_file(folder), root_action=False, **settings)
