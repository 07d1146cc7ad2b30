"""Cameras of pictures of a batch: of the task, of a head, of a hand, or placed by settings, on the device.

A picture is a function of the state alone: a camera that follows an avatar sticks to it, without the glide that films
have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.core.structs import fill
from piavatar_envs.render.scene import Camera
from piavatar_envs.render.views import Shot, View, focal_length

if TYPE_CHECKING:
    from piavatar_envs.avatar.body.asset import AvatarAsset
    from piavatar_envs.sim.world import Simulation

wp.set_module_options({"enable_backward": False})

#: Names of the cameras that a body has, and the bone that each is fixed to.
BODY_CAMERAS = {"head": "head", "left_hand": "left_wrist", "right_hand": "right_wrist"}
#: Vertical angle of a camera on a body [deg].
BODY_FIELD_OF_VIEW = 90.0
#: Angle by which people look down when they look ahead [rad]: the normal line of sight of ISO 11064-4.
GAZE = math.radians(15.0)
#: Distance of such a camera from the body, so that no picture shows the inside of its own head or hand [m].
AHEAD = 0.03
#: Share of a vertex's weight that its bone has where the vertex belongs to it.
_MOST = 0.5


@dataclass(frozen=True)
class Mount:
    """A camera fixed to a bone.

    Attributes:
        bone: index of the joint.
        offset: of the eye from the joint in the rest pose [m].
        forward: where it looks in the rest pose; unit.
        up: what is up in the picture, in the rest pose; unit.
    """

    bone: int
    offset: tuple[float, float, float]
    forward: tuple[float, float, float]
    up: tuple[float, float, float]


def mount_on(asset: AvatarAsset, camera: str) -> Mount:
    """Return the mount of a camera of :data:`BODY_CAMERAS`, by the mean shape of a body.

    The head's camera is in front of the face, at half of its height, and looks ahead, :data:`GAZE` downwards.
    A hand's camera is beyond the fingertips, and looks along the fingers; up is where the thumb is.

    Raises:
        ValueError: there is no such camera.
    """
    if camera not in BODY_CAMERAS:
        raise ValueError(f"camera={camera!r} is not on a body; use one of {', '.join(BODY_CAMERAS)}")
    bone = joint_index(BODY_CAMERAS[camera])
    body = asset.mean_body()
    weight = np.where(asset.skin_joints == bone, asset.skin_weights, 0.0).sum(axis=1)
    own = body.vertices[weight > _MOST] - body.joints[bone]
    if camera == "head":
        face, sine, cosine = np.array([0.0, -1.0, 0.0]), math.sin(GAZE), math.cos(GAZE)
        forward, up = np.array([0.0, -cosine, -sine]), np.array([0.0, -sine, cosine])
        middle = np.array([0.0, 0.0, 0.5 * (own[:, 2].min() + own[:, 2].max())])
    else:
        middle = own.mean(axis=0)
        face = forward = middle / np.linalg.norm(middle)
        up = np.array([0.0, -1.0, 0.0]) + forward[1] * forward
        up /= np.linalg.norm(up)
    reach = (own @ face).max() + AHEAD
    offset = middle + (reach - middle @ face) * face
    return Mount(bone, *(tuple(float(value) for value in vector) for vector in (offset, forward, up)))


@wp.struct
class Placement:
    """Constants of a camera: vectors are in the world, or in the rest pose of a bone."""

    offset: wp.vec3  # of the eye from the followed point or from the joint [m]
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    focal: float  # [px]
    width: int
    height: int


@wp.func
def view_from(placement: Placement, point: wp.vec3, turn: wp.quat):
    """Return a camera from the point that it is fixed to [m], turned with it."""
    view = View()
    view.eye = point + wp.quat_rotate(turn, placement.offset)
    view.right = wp.quat_rotate(turn, placement.right)
    view.up = wp.quat_rotate(turn, placement.up)
    view.forward = wp.quat_rotate(turn, placement.forward)
    view.focal = placement.focal
    view.width = placement.width
    view.height = placement.height
    return view


@wp.kernel
def follow_roots(
    envs: wp.array(dtype=int),
    position: wp.array2d(dtype=wp.vec3),
    share: float,
    is_first: int,
    # in and out
    centers: wp.array(dtype=wp.vec2),
):
    """Add a ``share`` of the place of an avatar's root on the ground to the followed points; over ``(pictures,)``."""
    i = wp.tid()
    root = position[envs[i], 0]
    own = share * wp.vec2(root[0], root[1])
    if is_first == 0:
        own += centers[i]
    centers[i] = own


@wp.kernel
def place_views(
    placement: Placement,
    # in and out
    centers: wp.array(dtype=wp.vec2),
    # out
    views: wp.array(dtype=View),
):
    """Place a camera about the followed points; over ``(pictures,)``."""
    i = wp.tid()
    center = centers[i]
    views[i] = view_from(placement, wp.vec3(center[0], center[1], 0.0), wp.quat_identity())


@wp.kernel
def mount_views(
    envs: wp.array(dtype=int),
    placement: Placement,
    bone: int,
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    # out
    centers: wp.array(dtype=wp.vec2),
    views: wp.array(dtype=View),
):
    """Place a camera on a bone; the ground fades about the root. Over ``(pictures,)``."""
    i = wp.tid()
    e = envs[i]
    views[i] = view_from(placement, position[e, bone], rotation[e, bone])
    centers[i] = wp.vec2(position[e, 0][0], position[e, 0][1])


class BatchCamera:
    """Writes the cameras of the pictures of a batch.

    Attributes:
        views: of every picture, ``(pictures,)`` of :class:`~piavatar_envs.render.views.View`.
        centers: points of the ground about which it fades [m], ``(pictures,)`` vec2.
    """

    def __init__(
        self,
        simulation: Simulation,
        camera: Camera | str,
        width: int,
        height: int,
        envs: wp.array,
        *,
        follows: bool = True,
        agent: int = 0,
        field_of_view: float | None = None,
        out: tuple[wp.array, wp.array] | None = None,
    ) -> None:
        """Allocate the cameras; nothing is placed yet.

        Args:
            simulation: the simulated world.
            camera: seen from the ground below the avatars' middle, or one of :data:`BODY_CAMERAS`.
            width: of a picture [px].
            height: of a picture [px].
            envs: environment of each picture, ``(pictures,)`` int32.
            follows: whether a camera that is not on a body follows the avatars, or stands about the origin.
            agent: index of the avatar whose body it is on.
            field_of_view: vertical angle of a camera that is on a body [deg].
            out: views and centers to write; new arrays if not given.

        Raises:
            ValueError: there is no such camera.
        """
        self._simulation, self._envs, self._follows, self._agent = simulation, envs, follows, agent
        device, pictures = simulation.device, len(envs)
        self.views, self.centers = out or (
            wp.zeros(pictures, dtype=View, device=device),
            wp.zeros(pictures, dtype=wp.vec2, device=device),
        )
        self._mount = None if isinstance(camera, Camera) else mount_on(simulation.flesh[agent].asset, camera)
        if self._mount is None:
            shot = Shot(np.array(camera.position), np.array(camera.target), camera.field_of_view, np.zeros(2))
            forward, right, up = shot.axes
            offset, focal = camera.position, shot.focal(height)
        else:
            forward, up, offset = np.array(self._mount.forward), np.array(self._mount.up), self._mount.offset
            right = np.cross(forward, up)
            focal = focal_length(field_of_view or BODY_FIELD_OF_VIEW, height)
        vectors = {"offset": offset, "right": right, "up": up, "forward": forward}
        self._placement = fill(
            Placement(),
            focal=float(focal),
            width=width,
            height=height,
            **{name: wp.vec3(*(float(value) for value in vector)) for name, vector in vectors.items()},
        )

    def record(self, graph: LaunchGraph) -> None:
        """Append the launches that write the cameras of the present state."""
        pictures, avatars = len(self._envs), self._simulation.avatars
        if self._mount is not None:
            tracked = avatars[self._agent].tracked
            inputs = [self._envs, self._placement, self._mount.bone, tracked.position, tracked.rotation]
            graph.launch(mount_views, pictures, inputs, [self.centers, self.views])
            return
        for index, avatar in enumerate(avatars):
            share = float(self._follows) / len(avatars)
            inputs = [self._envs, avatar.tracked.position, share, int(index == 0)]
            graph.launch(follow_roots, pictures, inputs, [self.centers])
        graph.launch(place_views, pictures, [self._placement, self.centers], [self.views])
