"""The ground: a pale checker that fades into the background (Warp)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from piavatar_envs.render.scene import Color
from piavatar_envs.render.views import Rays

wp.set_module_options({"enable_backward": False})

#: Side of a checker square [m], and the share of it that the line between two squares takes.
SQUARE, _LINE_SHARE = wp.constant(0.5), wp.constant(2.0 / 256.0)
#: Just below z = 0 [m], so that soles on it stay visible.
HEIGHT = wp.constant(-0.004)
#: Distances from the picture's centre at which the ground begins to fade, and has faded [m].
_FADE_START, FADE_END = wp.constant(1.6), wp.constant(7.5)


@dataclass(frozen=True)
class GroundStyle:
    """Colours of the ground and the background, sRGB in [0, 1].

    Attributes:
        light: of every other square.
        dark: of the other ones.
        line: between squares.
        sky_top: background at the upper edge of a picture.
        sky_bottom: background at its lower edge.
        shadow: of the shadow where it is darkest.
    """

    light: Color = (0.915, 0.91, 0.90)
    dark: Color = (0.875, 0.87, 0.862)
    line: Color = (0.80, 0.795, 0.79)
    sky_top: Color = (0.80, 0.83, 0.87)
    sky_bottom: Color = (0.95, 0.95, 0.945)
    shadow: Color = (0.20, 0.19, 0.22)


@wp.struct
class Ground:
    """Colours of a :class:`GroundStyle`."""

    light: wp.vec3
    dark: wp.vec3
    line: wp.vec3
    sky_top: wp.vec3
    sky_bottom: wp.vec3
    shadow: wp.vec3


@wp.func
def ground_at(eye: wp.vec3, ray: wp.vec3) -> wp.vec3:
    """Return the ground that a ray meets: x, y [m] and the inverse depth [1/m], 0 where it meets none."""
    below = HEIGHT - eye[2]
    result = wp.vec3()
    if ray[2] < -1.0e-5 and below < 0.0:
        depth = below / ray[2]
        result = wp.vec3(eye[0] + depth * ray[0], eye[1] + depth * ray[1], ray[2] / below)
    return result


@wp.func
def ground_share(at: wp.vec3, center: wp.vec2) -> float:
    """Return the opacity of the ground at a point of :func:`ground_at`."""
    result = float(0.0)
    if at[2] > 0.0:
        distance = wp.length(wp.vec2(at[0], at[1]) - center)
        share = wp.clamp((FADE_END - distance) / (FADE_END - _FADE_START), 0.0, 1.0)
        result = share * share * (3.0 - 2.0 * share)
    return result


@wp.func
def triangle_wave(x: float) -> float:
    """Return the integral of the square wave of period 2, for a box filter."""
    return 2.0 * wp.abs(0.5 * x - wp.floor(0.5 * x) - 0.5)


@wp.func
def lines_integral(x: float) -> float:
    """Return the integral of the lines at whole numbers."""
    return wp.floor(x) * _LINE_SHARE + wp.min(x - wp.floor(x), _LINE_SHARE)


@wp.func
def checker(ground: Ground, rays: Rays, eye: wp.vec3, ray: wp.vec3, at: wp.vec3) -> wp.vec3:
    """Return the ground's colour averaged over the pixel whose ray meets the ground at ``at``."""
    # The derivatives of the point by the pixel's position.
    scale = (HEIGHT - eye[2]) / (ray[2] * ray[2]) / SQUARE
    right = (rays.right * ray[2] - ray * rays.right[2]) * scale
    down = (rays.down * ray[2] - ray * rays.down[2]) * scale
    width = wp.max(wp.abs(right[0]) + wp.abs(down[0]), 1.0e-6)
    height = wp.max(wp.abs(right[1]) + wp.abs(down[1]), 1.0e-6)
    left = at[0] / SQUARE - 0.5 * width
    low = at[1] / SQUARE - 0.5 * height
    across = 1.0 / width
    along = 1.0 / height
    sx = (triangle_wave(left) - triangle_wave(left + width)) * across
    sy = (triangle_wave(low) - triangle_wave(low + height)) * along
    color = wp.lerp(ground.light, ground.dark, 0.5 - 0.5 * sx * sy)
    lx = (lines_integral(left + width) - lines_integral(left)) * across
    ly = (lines_integral(low + height) - lines_integral(low)) * along
    return wp.lerp(color, ground.line, lx + ly - lx * ly)
