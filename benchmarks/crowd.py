"""Bodies at the paper's scale: particles on a body's skin or in its interior, one body alone or a queue that touches.

The bodies of a queue stand one behind the other, the hands of each on the next. They sway a few millimetres against
each other, so that contact has work to do, and are otherwise at rest: there is no gravity, because the benchmark lets
the root wrench act in one of a hundred substeps only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import warp as wp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.asset import AvatarAsset, dense_weights, load_body, mesh_volume, top_weights
from piavatar_envs.avatar.body import BodyPoints
from piavatar_envs.avatar.drive import AvatarDrive, record_control_step, record_end_of_step
from piavatar_envs.avatar.ordering import order_along_curve, order_in_boxes
from piavatar_envs.avatar.sampling import sample_particles
from piavatar_envs.avatar.settings import DriveSettings
from piavatar_envs.avatar.skeleton import BODY_PARTS, NUM_JOINTS, body_part_of_joint, joint_index
from piavatar_envs.avatar.substeps import record_drive
from piavatar_envs.mpm.boundaries import Collider
from piavatar_envs.mpm.build import MaterialPoints, build_model, make_grid
from piavatar_envs.mpm.fields import Fields
from piavatar_envs.mpm.memory import LARGE_MARGIN, allocate, estimate_slots
from piavatar_envs.mpm.program import Program
from piavatar_envs.mpm.solver import record_begin, record_substeps
from piavatar_envs.mpm.types import Grid, failure_name

DENSITY = 1000.0
FRICTION = 0.5
TRACKERS = 20  # particles that track a bone, as many as the environments have
BONE_RINGS = 4  # of interior bodies: TRACKERS particles a bone
TOUCH = 0.5  # between the nearest particles of neighbours in a queue, over the grid spacing
SWAY = 0.004  # of the root in a control step, neighbours in opposite directions [m]
#: Of the joints that act [rad]; small, because particles leave the arc for its tangent, which stretches a limb.
TURN = 0.03
#: Slots of a skin, over those that it takes at rest: substeps in one launch each are marked anew every 50 only.
SKIN_MARGIN = 3.0
ACTING = ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "neck", "spine2")


@dataclass(frozen=True)
class Scale:
    """Sizes of the benchmark; the defaults are the paper's.

    Attributes:
        nodes: grid nodes along each edge of the domain.
        width: of the domain [m].
        skin: particles on the skin of a body.
        interior: particles in the interior of a body.
        substeps: of a control step.
    """

    nodes: int = 200
    width: float = 2.0
    skin: int = 10_475
    interior: int = 300_000
    substeps: int = 100

    @property
    def dx(self) -> float:
        """Grid spacing [m]."""
        return self.width / self.nodes

    def grid(self) -> Grid:
        """The domain, its floor a little below the soles."""
        inside = (self.nodes - 4.5) * self.dx  # the grid adds four nodes; half a node keeps its rounding from a fifth
        low = np.array([-0.5 * inside, -0.5 * inside, -3.0 * self.dx])
        return make_grid(low, low + inside, self.dx)


#: For smoke runs: figures mean nothing.
SMALL = Scale(nodes=30, width=2.4, skin=1200, interior=700, substeps=12)


@lru_cache(maxsize=4)
def skin_body(count: int, seed: int = 0) -> tuple[BodyPoints, np.ndarray]:
    """``count`` particles on the skin of the mean body and their volumes [m^3]; each has the same share of its mass.

    Area-weighted: one random point in each of ``count`` equal parts of the skin's area. Weights are those of the skin
    there; the firmest particles of every bone track it.
    """
    asset, rng = load_body(), np.random.default_rng(seed)
    body = asset.mean_body()
    corners = body.vertices[asset.faces].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.cumsum(area) / area.sum()
    face = np.minimum(np.searchsorted(share, (np.arange(count) + rng.random(count)) / count), len(area) - 1)
    root, along = np.sqrt(rng.random(count)), rng.random(count)  # uniform in a triangle
    coordinates = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    positions = np.einsum("pc,pci->pi", coordinates, corners[face]).astype(np.float32)
    dense = dense_weights(asset.skin_joints, asset.skin_weights)[asset.faces[face]]
    weights = np.einsum("pc,pcj->pj", coordinates, dense)
    order = order_along_curve(positions, math.sqrt(area.sum() / count))
    positions, weights = positions[order], weights[order]
    bone = _trackers(positions, weights)
    volume = np.full(count, mesh_volume(body.vertices, asset.faces) / count, np.float32)
    return _body_points(asset, positions, volume, *top_weights(weights), bone), volume


@lru_cache(maxsize=4)
def interior_body(count: int, seed: int = 0) -> tuple[BodyPoints, np.ndarray]:
    """``count`` particles inside the mean body and their volumes [m^3], sampled as those of the environments.

    The lattice's spacing is chosen for a little more than ``count``; flesh particles drawn with ``seed`` are left out,
    and the others take their volume over.

    Raises:
        ValueError: fewer than the bone particles alone.
    """
    asset = load_body()
    flesh = count - NUM_JOINTS * TRACKERS
    if flesh <= 0:
        raise ValueError(f"count={count} particles in a body; there are {NUM_JOINTS * TRACKERS} bone particles already")
    spacing = min(0.08, (mesh_volume(asset.vertices, asset.faces) / flesh) ** (1.0 / 3.0))
    while len(particles := sample_particles(asset, spacing, bone_rings=BONE_RINGS)) < count:
        spacing *= 0.98
    found = np.flatnonzero(particles.bone < 0)
    dropped = np.random.default_rng(seed).choice(found, len(particles) - count, replace=False)
    keep = np.setdiff1d(np.arange(len(particles)), dropped)
    keep = keep[order_in_boxes(particles.rest_positions[keep])]
    volume = particles.volumes[keep].astype(np.float64)
    volume = (volume * (particles.volumes.sum(dtype=np.float64) / volume.sum())).astype(np.float32)
    joints, weights = particles.skin_joints[keep], particles.skin_weights[keep]
    return _body_points(asset, particles.rest_positions[keep], volume, joints, weights, particles.bone[keep]), volume


def _body_points(asset: AvatarAsset, positions, volume, skin_joints, skin_weights, bone) -> BodyPoints:
    count = len(positions)
    return BodyPoints(
        rest=positions[None],
        mass=(DENSITY * volume)[None].astype(np.float32),
        joints=asset.mean_body().joints[None],
        skin_joints=skin_joints,
        skin_weights=skin_weights,
        bone=bone,
        inert=np.zeros((1, count), np.float32),
    )


def _trackers(positions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The bone that each particle tracks, -1 for most: of each bone's firmest particles those that spread widest."""
    bone = np.full(len(positions), -1, np.int32)
    for joint in np.argsort(weights.sum(0)):  # small bones choose first
        free = np.flatnonzero(bone < 0)
        firm = free[np.argsort(-weights[free, joint], kind="stable")[: 3 * TRACKERS]]
        chosen = [firm[0]]
        distance = np.full(len(firm), np.inf)
        while len(chosen) < TRACKERS:
            distance = np.minimum(distance, np.linalg.norm(positions[firm] - positions[chosen[-1]], axis=1))
            chosen.append(firm[distance.argmax()])
        bone[chosen] = joint
    return bone


def queue_step(rest: np.ndarray, gap: float) -> float:
    """How far apart along y bodies of particles ``rest`` ``(P, 3)`` [m] are when their nearest are ``gap`` [m] apart.

    They come from afar, each time by the distance that is surely free.
    """
    tree, step = cKDTree(rest), float(np.ptp(rest[:, 1])) + gap
    while (free := tree.query(rest + [0.0, step, 0.0], workers=-1)[0].min() - gap) > 0.02 * gap:
        step -= free
    return step


def _one_a_cell(positions: np.ndarray, dx: float) -> np.ndarray:
    """A point in each cell of a grid that holds some of ``positions`` ``(P, 3)`` [m], where only cells matter."""
    return (np.unique(np.floor(positions / dx - 0.5).astype(int), axis=0) + 1.0) * dx


def _slots(rest: np.ndarray, dx: float) -> int:
    """Slots of a body of particles ``rest`` ``(P, 3)`` [m]; a skin leaves blocks behind for longer than others."""
    cells = _one_a_cell(rest, dx)
    margin = SKIN_MARGIN if 2 * len(cells) > len(rest) else LARGE_MARGIN
    return estimate_slots(cells, None, dx, margin)


class Crowd:
    """``count`` equal bodies in one world, each a subject with a velocity field of its own, in a queue along y.

    Attributes:
        once: program of a control step whose drive acts before the first substep only.
        each: program of a control step whose drive acts before every substep, as in the environments.
    """

    def __init__(
        self,
        points: BodyPoints,
        volume: np.ndarray,
        count: int,
        scale: Scale,
        device: str,
        scatter: str | None = None,
    ) -> None:
        """Build the world and place the bodies in their rest pose.

        Args:
            points: a body.
            volume: of its particles [m^3], shape ``(P,)``.
            count: number of bodies.
            scale: sizes.
            device: Warp device.
            scatter: how particles reach the nodes, a key of ``SCATTERS``; the device's own way if not given.

        Raises:
            ValueError: the queue does not fit into the domain.
        """
        self.count, self.scale, own = count, scale, points.num_points
        part = body_part_of_joint()[points.skin_joints[:, 0]]
        matter = replace(
            MaterialPoints.uniform(np.tile(volume, count), DENSITY),
            field=np.repeat(np.arange(count), own),
            sensor=np.concatenate([index * len(BODY_PARTS) + part for index in range(count)]),
        )
        self.model = build_model(
            matter,
            scale.grid(),
            device=device,
            num_substeps=scale.substeps,
            gravity=(0.0, 0.0, 0.0),
            colliders=[Collider.plane((0.0, 0.0, 1.0), 0.0, FRICTION)],
            fields=Fields(tuple(range(count)), FRICTION, DENSITY, num_sensors=count * len(BODY_PARTS)),
            max_slots=count * _slots(points.rest[0], scale.dx),
            rest=np.tile(points.rest[0], (count, 1)),
            scatter=scatter,
        )
        self.state, self.scratch = allocate(self.model)
        self.avatars = [AvatarDrive(points, index * own, self.model, DriveSettings()) for index in range(count)]
        self._record()
        self._place(points)

    def _record(self) -> None:
        self.once, self.each = Program(self.model.device), Program(self.model.device)
        world = (self.model, self.state, self.scratch)
        begins = self.once.branches(self.avatars, lambda avatar, own: avatar.record_begin(own))
        record_begin(self.once, *world, begins)
        self.once.fork_each(self.avatars, lambda avatar, own: record_drive(avatar, own, self.state, 0))
        record_substeps(self.once, *world)
        record_end_of_step(self.once, self.avatars, *world)
        record_control_step(self.each, self.avatars, *world)

    def _place(self, points: BodyPoints) -> None:
        step = queue_step(points.rest[0], TOUCH * self.scale.dx) if self.count > 1 else 0.0
        depth = step * (self.count - 1) + float(np.ptp(points.rest[0][:, 1]))
        room = self.scale.width - 8.0 * self.scale.dx
        if depth > room:
            raise ValueError(f"a queue of {self.count} bodies is {depth:.2f} m deep; the domain has {room:.2f} m")
        behind = step * np.arange(self.count)
        middle = 0.5 * float(points.rest[0][:, 1].min() + points.rest[0][:, 1].max()) + behind.mean()
        self.roots = points.joints[0, 0] + np.stack([0.0 * behind, behind - middle, 0.0 * behind], axis=1)
        self._reset = Program(self.model.device)
        self._everywhere = wp.ones(1, dtype=wp.bool, device=self.model.device)
        for avatar in self.avatars:
            avatar.record_reset(self._reset, self.state, self._everywhere)
            avatar.record_tracking(self._reset, self.state)
        self.reset()

    def reset(self) -> None:
        """Bodies at rest where they began. Without a pull of the drive in every substep contact carries them off."""
        identity = np.tile(np.array([0.0, 0.0, 0.0, 1.0], np.float32), (1, NUM_JOINTS, 1))
        for avatar, root in zip(self.avatars, self.roots, strict=True):
            avatar.state.command_rotation.assign(identity)
            avatar.state.command_root.assign(root[None].astype(np.float32))
        self._reset.run()

    def command(self, sign: int) -> None:
        """Set the goals of the next control step: joints and roots to one side (1) or the other (-1)."""
        for index, (avatar, root) in enumerate(zip(self.avatars, self.roots, strict=True)):
            way = float(sign if index % 2 else -sign)
            turns = np.zeros((NUM_JOINTS, 3))
            turns[[joint_index(name) for name in ACTING]] = 0.5 * way * TURN
            rotation = Rotation.from_rotvec(turns).as_quat().astype(np.float32)
            avatar.state.goal_rotation.assign(rotation[None])
            shift = root + [0.0, 0.5 * way * SWAY, 0.0]
            avatar.state.goal_root.assign(shift[None].astype(np.float32))

    def touching(self) -> int:
        """Pairs of neighbours that pushed each other in the last control step."""
        impulse = self.scratch.sensors.pair_impulse.numpy()[0].reshape(self.count, self.count, 3)
        return int(sum(np.any(impulse[a, a + 1] != 0.0) for a in range(self.count - 1)))

    @property
    def failure(self) -> str | None:
        """Why the simulation has failed; None if it has not."""
        return failure_name(int(self.state.failure.numpy()[0]))
