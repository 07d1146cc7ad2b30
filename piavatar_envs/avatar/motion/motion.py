"""Motion clip: local joint rotations and a root path sampled at a fixed rate, and their interpolation (wxyz).

A clip that loops ends on the pose it starts from, up to a turn about the vertical and a step on the ground: its last
frame *is* the first frame of the next round. That turn and step are carried on from round to round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, forward_kinematics
from piavatar_envs.avatar.motion.ground import ground_level, lowest_heights

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset, ShapedBody

MAX_FPS = 1000.0  # [1/s], beyond any motion capture: a larger figure is a unit mistake
#: Greatest turn of a joint in a file [rad]; vectors and angles of recordings may exceed a full turn.
GREATEST_TURN = 4.0 * np.pi
UNIT_TOLERANCE = 1e-3  # how far a quaternion's norm may be from 1 before it is refused, not normalised
SEAM_ANGLE = 1e-3  # [rad] largest joint rotation left between the end and the start of a loop
SEAM_HEIGHT = 1e-3  # [m] largest root height left between the end and the start of a loop
NEAR_ANGLE = 0.35  # [rad] of a joint between the end and the start of a clip that can be closed
NEAR_HEIGHT = 0.05  # [m] of its root
NEAR_SPEED = 4.0  # [rad/s] by which a joint turns otherwise at the start
_MIRROR = np.array([1.0, 1.0, -1.0, -1.0])  # a wxyz rotation seen in a mirror normal to x
_SWAPPED = [
    JOINT_NAMES.index(
        name.replace("left", "right") if name.startswith("left") else name.replace("right", "left")  # sides swap
    )
    for name in JOINT_NAMES
]


@dataclass(frozen=True, eq=False)
class Motion:
    """A clip of the 22-joint skeleton, immutable: every method returns a new clip.

    Attributes:
        name: its name for :func:`~piavatar_envs.avatar.motion.load_motion`.
        fps: frames per second [1/s].
        local_rotations: rotation of each joint relative to its parent (the root: to the world), wxyz, identity in the
            rest pose of the embedded body, shape ``(num_frames, 22, 4)``; successive frames lie in one hemisphere.
        root_position: the pelvis joint [m], shape ``(num_frames, 3)``, z up.
        loop: whether sampling past the end starts again, the root carried on.
        source: where the clip comes from, e.g. ``"procedural"`` or ``"DeepMimic humanoid3d_walk"``.
        notes: what was found or guessed when it was read, one sentence each.

    Raises:
        ValueError: wrong shapes, non-finite values, quaternions that are not unit, a rate out of range, or a loop
            whose end does not meet its start.
    """

    name: str
    fps: float
    local_rotations: np.ndarray
    root_position: np.ndarray
    loop: bool = False
    source: str = "unknown"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        rotations = np.array(self.local_rotations, dtype=np.float64)
        root = np.array(self.root_position, dtype=np.float64)
        if not (np.isfinite(self.fps) and 0.0 < self.fps <= MAX_FPS):
            raise ValueError(
                f"motion {self.name!r}: fps={self.fps} is outside (0, {MAX_FPS:g}] frames/s; correct the rate"
            )
        if rotations.ndim != 3 or rotations.shape[1:] != (NUM_JOINTS, 4):
            raise ValueError(
                f"motion {self.name!r}: local_rotations has shape {rotations.shape}, expected (num_frames, "
                f"{NUM_JOINTS}, 4): one wxyz quaternion a frame and joint"
            )
        if len(rotations) < 2 or root.shape != (len(rotations), 3):
            raise ValueError(
                f"motion {self.name!r}: {len(rotations)} frames of rotations and root_position of shape {root.shape}; "
                "give at least 2 frames and root_position of shape (num_frames, 3)"
            )
        _require_finite(self.name, "local_rotations", rotations)
        _require_finite(self.name, "root_position", root)
        rotations = hemisphere_consistent(_normalised(self.name, rotations))
        for field, value in (("local_rotations", rotations), ("root_position", root)):
            value.flags.writeable = False
            object.__setattr__(self, field, value)
        object.__setattr__(self, "fps", float(self.fps))
        if self.loop:
            self._require_closed()

    @property
    def num_frames(self) -> int:
        """Return the number of frames."""
        return len(self.root_position)

    @property
    def duration(self) -> float:
        """Return the time from the first frame to the last, the period of a loop [s]."""
        return (self.num_frames - 1) / self.fps

    @property
    def loop_heading(self) -> float:
        """Return the turn about the vertical over the clip [rad]."""
        turn = Rotation.from_quat(self.local_rotations[-1, 0], scalar_first=True)
        turn *= Rotation.from_quat(self.local_rotations[0, 0], scalar_first=True).inv()
        w, _, _, z = turn.as_quat(scalar_first=True)
        return float(np.remainder(2.0 * np.arctan2(z, w) + np.pi, 2.0 * np.pi) - np.pi)

    def sample(self, time: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pose at a time, on the arc between the two nearest frames.

        Args:
            time: [s], a number or an array of shape ``(...)``. Past its ends a clip that does not loop holds its
                first or last pose.

        Returns:
            Local rotations ``(..., 22, 4)`` wxyz and root position ``(..., 3)`` [m].

        Raises:
            ValueError: a time that is not finite.
        """
        time = np.asarray(time, dtype=np.float64)
        if not np.isfinite(time).all():
            raise ValueError(f"motion {self.name!r}: time={time[~np.isfinite(time)].flat[0]} s is not finite")
        rounds = np.floor(time / self.duration) if self.loop else np.zeros_like(time)
        frame = np.clip((time - rounds * self.duration) * self.fps, 0.0, self.num_frames - 1.0)
        first = np.minimum(frame.astype(np.int64), self.num_frames - 2)
        blend = frame - first
        rotations = slerp(self.local_rotations[first], self.local_rotations[first + 1], blend[..., None])
        root = (1.0 - blend)[..., None] * self.root_position[first] + blend[..., None] * self.root_position[first + 1]
        return self._carry(rotations, root, rounds) if self.loop else (rotations, root)

    def joint_frames(self, rest_joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute forward kinematics of every frame.

        Args:
            rest_joints: joints of a body's rest pose [m], shape ``(22, 3)``.

        Returns:
            World rotations ``(num_frames, 22, 3, 3)`` and joint positions [m] ``(num_frames, 22, 3)``.
        """
        matrices = Rotation.from_quat(self.local_rotations.reshape(-1, 4), scalar_first=True).as_matrix()
        rest = np.asarray(rest_joints, dtype=np.float64)
        return forward_kinematics(matrices.reshape(-1, NUM_JOINTS, 3, 3), self.root_position, rest)

    def joint_speeds(self) -> np.ndarray:
        """Return how fast each joint turns between frames [rad/s], shape ``(num_frames - 1, 22)``."""
        parts = (self.local_rotations[:-1].reshape(-1, 4), self.local_rotations[1:].reshape(-1, 4))
        first, second = (Rotation.from_quat(part, scalar_first=True) for part in parts)
        return (first.inv() * second).magnitude().reshape(-1, NUM_JOINTS) * self.fps

    def resample(self, fps: float) -> Motion:
        """Return the same clip at another rate.

        A loop keeps a whole number of frames a round: its period changes by half a new frame at most. A clip that
        does not loop holds its last pose for less than one new frame.

        Raises:
            ValueError: ``fps`` is not in range.
        """
        if not (np.isfinite(fps) and 0.0 < fps <= MAX_FPS):
            raise ValueError(f"motion {self.name!r}: cannot resample to fps={fps}, the range is (0, {MAX_FPS:g}]")
        steps = self.duration * fps
        count = max(1, round(steps) if self.loop else int(np.ceil(steps - 1e-6)))
        times = np.arange(count + 1) / fps
        if self.loop:
            times *= self.duration / times[-1]
        # Sampled as a single pass, so that the last frame is the end of the round and not the start of the next.
        rotations, root = replace(self, loop=False).sample(times)
        return replace(self, fps=fps, local_rotations=rotations, root_position=root)

    def closed(self, blend_time: float = 0.4, heading: float | None = None) -> Motion:
        """Return the clip as a loop: both ends are bent to meet half-way.

        Args:
            blend_time: how long before the end and after the start poses are changed [s], at most half the clip.
            heading: turn about the vertical a round shall make [rad]; without it the clip's own.
        """
        reach = min(blend_time, 0.5 * self.duration)
        time = np.arange(self.num_frames) / self.fps
        share = 0.5 * ease(1.0 - (self.duration - time) / reach) - 0.5 * ease(1.0 - time / reach)
        target = self.local_rotations[0].copy()
        target[0] = turned(self.loop_heading if heading is None else heading, target[0])
        gap = Rotation.from_quat(self.local_rotations[-1], scalar_first=True).inv()
        gap = (gap * Rotation.from_quat(target, scalar_first=True)).as_rotvec()
        change = Rotation.from_rotvec((share[:, None, None] * gap).reshape(-1, 3))
        rotations = Rotation.from_quat(self.local_rotations.reshape(-1, 4), scalar_first=True) * change
        quaternions = rotations.as_quat(scalar_first=True).reshape(self.local_rotations.shape)
        root = self.root_position.copy()
        root[:, 2] += share * (root[0, 2] - root[-1, 2])
        return replace(self, local_rotations=quaternions, root_position=root, loop=True)

    def meets_itself(self) -> bool:
        """Return whether the end nearly meets the start, up to a turn about the vertical and a step on the ground.

        Poses must agree within what a blend hides (:data:`NEAR_ANGLE`, :data:`NEAR_HEIGHT`), and joints change their
        speeds there by at most :data:`NEAR_SPEED`, or twice as much as between any frames of the clip.
        """
        angles, height = self._gap()
        parts = (self.local_rotations[:-1].reshape(-1, 4), self.local_rotations[1:].reshape(-1, 4))
        first, second = (Rotation.from_quat(part, scalar_first=True) for part in parts)
        speeds = self.fps * (first.inv() * second).as_rotvec().reshape(-1, NUM_JOINTS, 3)
        changes = np.linalg.norm(np.diff(speeds, axis=0), axis=-1).max(initial=0.0)
        change = np.linalg.norm(speeds[-1] - speeds[0], axis=-1).max()
        return bool(angles.max() < NEAR_ANGLE and height < NEAR_HEIGHT and change < max(NEAR_SPEED, 2.0 * changes))

    def mirrored(self) -> Motion:
        """Return the clip seen in a mirror: left and right change places, world x changes sign."""
        rotations = self.local_rotations[:, _SWAPPED] * _MIRROR
        root = self.root_position * np.array([-1.0, 1.0, 1.0])
        return replace(self, name=f"{self.name}:mirrored", local_rotations=rotations, root_position=root)

    def translated(self, offset: np.ndarray) -> Motion:
        """Return the clip moved by ``offset`` [m], shape ``(3,)``."""
        return replace(self, root_position=self.root_position + np.asarray(offset, dtype=np.float64))

    def on_ground(self, asset: AvatarAsset, body: ShapedBody | None = None, window: float | None = None) -> Motion:
        """Return the clip raised or lowered so that the skin touches z = 0 and never goes below it.

        Args:
            asset: the avatar whose skin is meant.
            body: one of its shapes; without it the mean shape.
            window: without it one shift for the whole clip, which then touches the ground in its lowest frame. With it
                [s] a smooth one, so that the clip comes down to the ground in about every window, for clips whose
                contact drifts (another skeleton's). Flights shorter than the window are kept.
        """
        heights = lowest_heights(self, asset, body)
        level = np.full(self.num_frames, heights.min())
        if window is not None:
            level = ground_level(heights, self.fps, window, self.loop)
        return replace(self, root_position=self.root_position - level[:, None] * np.array([0.0, 0.0, 1.0]))

    def _carry(self, rotations: np.ndarray, root: np.ndarray, rounds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply the loop's turn and step ``rounds`` times, in closed form (the ground plane as complex numbers)."""
        heading = self.loop_heading
        turn = np.exp(1j * heading)
        start, end = self.root_position[0] @ [1, 1j, 0], self.root_position[-1] @ [1, 1j, 0]
        step = end - turn * start
        # 1 + turn + ... + turn^(rounds - 1); below the threshold its limit, or the quotient loses its digits
        total = rounds if abs(heading) < 1e-9 else (turn**rounds - 1.0) / (turn - 1.0)
        plane = turn**rounds * (root @ [1, 1j, 0]) + step * total
        rotations = rotations.copy()
        rotations[..., 0, :] = turned(heading * rounds, rotations[..., 0, :])
        return rotations, np.stack([plane.real, plane.imag, root[..., 2]], axis=-1)

    def _gap(self) -> tuple[np.ndarray, float]:
        """Return angles by joint [rad] and the height [m] between the last frame and the first, less the heading."""
        target = self.local_rotations[0].copy()
        target[0] = turned(self.loop_heading, target[0])
        gap = Rotation.from_quat(self.local_rotations[-1], scalar_first=True).inv()
        angles = (gap * Rotation.from_quat(target, scalar_first=True)).magnitude()
        return angles, float(abs(self.root_position[-1, 2] - self.root_position[0, 2]))

    def _require_closed(self) -> None:
        angles, height = self._gap()
        if angles.max() > SEAM_ANGLE or height > SEAM_HEIGHT:
            raise ValueError(
                f"motion {self.name!r} does not close: {JOINT_NAMES[int(angles.argmax())]} differs by "
                f"{angles.max():.4f} rad (limit {SEAM_ANGLE:g}) and the root height by {height:.4f} m (limit "
                f"{SEAM_HEIGHT:g}) between the last frame and the first; build it with loop=False and call closed()"
            )


def _require_finite(name: str, field: str, values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise ValueError(f"motion {name!r}: {field}{list(index)} is {values[index]}; every value must be finite")


def _normalised(name: str, rotations: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(rotations, axis=-1, keepdims=True)
    error = np.abs(norms - 1.0)[..., 0]
    if error.max() > UNIT_TOLERANCE:
        frame, joint = np.unravel_index(error.argmax(), error.shape)
        raise ValueError(
            f"motion {name!r}: the quaternion of {JOINT_NAMES[joint]} in frame {frame} has norm "
            f"{norms[frame, joint, 0]:.4f}, expected 1 within {UNIT_TOLERANCE:g}; normalise it"
        )
    return rotations / norms


def ease(phase: np.ndarray) -> np.ndarray:
    """Return the smooth step from 0 to 1 with zero speed and acceleration at both ends, ``6 s^5 - 15 s^4 + 10 s^3``."""
    s = np.clip(phase, 0.0, 1.0)
    return s * s * s * (s * (6.0 * s - 15.0) + 10.0)


def slerp(start: np.ndarray, end: np.ndarray, blend: np.ndarray) -> np.ndarray:
    """Return a fraction of the way along the shorter arc (Shoemake, "Animating rotation with quaternion curves", 1985).

    Args:
        start: wxyz, shape ``(..., 4)``.
        end: wxyz, shape ``(..., 4)``.
        blend: fraction in [0, 1], of a shape that broadcasts to ``(...)``.

    Returns:
        Unit quaternions wxyz, shape ``(..., 4)``, in the hemisphere of ``start``.
    """
    blend = np.broadcast_to(blend, start.shape[:-1]).reshape(-1, 1)
    first = Rotation.from_quat(start.reshape(-1, 4), scalar_first=True)
    arc = (first.inv() * Rotation.from_quat(end.reshape(-1, 4), scalar_first=True)).as_rotvec()
    result = (first * Rotation.from_rotvec(blend * arc)).as_quat(scalar_first=True).reshape(start.shape)
    return np.where((result * start).sum(-1, keepdims=True) < 0.0, -result, result)


def hemisphere_consistent(quaternions: np.ndarray) -> np.ndarray:
    """Choose signs so that no quaternion is more than a right angle (in 4D) from the one a frame before.

    Args:
        quaternions: shape ``(num_frames, ..., 4)``; the first frame's scalar part is made non-negative.
    """
    signs = np.empty(quaternions.shape[:-1])
    signs[0] = np.where(quaternions[0, ..., 0] < 0.0, -1.0, 1.0)
    signs[1:] = np.where((quaternions[1:] * quaternions[:-1]).sum(-1) < 0.0, -1.0, 1.0)
    return quaternions * np.cumprod(signs, axis=0)[..., None]


def turned(heading: float | np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return ``quaternion`` after a turn by ``heading`` [rad] about the vertical."""
    c, s = np.cos(0.5 * np.asarray(heading)), np.sin(0.5 * np.asarray(heading))
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], axis=-1)
