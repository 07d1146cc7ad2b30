"""Pictures and videos. Pictures need no library but Warp; text on them and videos need the extra ``render``."""

from piavatar_envs.avatar.skin import Skin
from piavatar_envs.render.overlay import label, side_by_side
from piavatar_envs.render.quantities import distortion, strain_magnitude
from piavatar_envs.render.renderer import Renderer
from piavatar_envs.render.scene import (
    PALETTE,
    PROP,
    Arrow,
    Body,
    Box,
    Camera,
    Capsule,
    Marker,
    MovedSplats,
    Ring,
    Scene,
    Solid,
    Sphere,
)
from piavatar_envs.render.video import write_video

__all__ = [
    "PALETTE",
    "PROP",
    "Arrow",
    "Body",
    "Box",
    "Camera",
    "Capsule",
    "Marker",
    "MovedSplats",
    "Renderer",
    "Ring",
    "Scene",
    "Skin",
    "Solid",
    "Sphere",
    "distortion",
    "label",
    "side_by_side",
    "strain_magnitude",
    "write_video",
]
