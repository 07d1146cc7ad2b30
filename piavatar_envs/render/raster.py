"""Kernels of the software renderer: triangles into samples, samples and the ground into a picture."""

from __future__ import annotations

import warp as wp

from piavatar_envs.render import ground

SAMPLES = wp.constant(2)  # along each side of a pixel
_NEAR = wp.constant(0.05)
_SQUARE = wp.constant(ground.SQUARE)
_LINE_SHARE = wp.constant(2.0 * ground.LINE_PIXELS / ground.TILE_PIXELS)
_FADE_START, _FADE_END = wp.constant(ground.FADE_START), wp.constant(ground.FADE_END)
_GROUND_HEIGHT = wp.constant(ground.HEIGHT)


@wp.struct
class View:
    """A perspective camera: the eye, its axes (right, up, forward), focal length in sample widths, picture size."""

    eye: wp.vec3
    right: wp.vec3
    up: wp.vec3
    forward: wp.vec3
    focal: float
    width: int
    height: int


@wp.struct
class GroundLook:
    """Colours (sRGB in [0, 255]) and the shadow's patch."""

    light: wp.vec3
    dark: wp.vec3
    line: wp.vec3
    sky_top: wp.vec3
    sky_bottom: wp.vec3
    shadow: wp.vec3
    center: wp.vec2
    shadow_origin: wp.vec2
    shadow_size: float


@wp.func
def project(view: View, point: wp.vec3) -> wp.vec3:
    """Sample coordinates (x right, y down) and the inverse depth [1/m], which is linear on the screen."""
    offset = point - view.eye
    inverse = 1.0 / wp.max(wp.dot(offset, view.forward), 1.0e-6)
    return wp.vec3(
        0.5 * float(view.width) + view.focal * wp.dot(offset, view.right) * inverse,
        0.5 * float(view.height) - view.focal * wp.dot(offset, view.up) * inverse,
        inverse,
    )


@wp.kernel
def rasterise(
    # in
    view: View,
    vertices: wp.array[wp.vec3],  # [m], (V,)
    colors: wp.array[wp.vec3],  # sRGB in [0, 255], (V,)
    corners: wp.array[wp.vec3i],  # (T,)
    # in, out
    nearest: wp.array2d[float],  # inverse depth [1/m], 0 where nothing is drawn
    image: wp.array2d[wp.vec3],
):
    """Draw the triangles' fronts into the samples, the nearest winning."""
    # One thread: triangles that overlap must not race for a sample, and a CPU launch has one core anyway.
    for triangle in range(corners.shape[0]):
        corner = corners[triangle]
        a = project(view, vertices[corner[0]])
        b = project(view, vertices[corner[1]])
        c = project(view, vertices[corner[2]])
        # Twice the signed area; positive where the front shows (y points down).
        area = (c[0] - a[0]) * (b[1] - a[1]) - (b[0] - a[0]) * (c[1] - a[1])
        if area > 1.0e-9 and wp.max(a[2], wp.max(b[2], c[2])) < 1.0 / _NEAR:
            left = wp.max(int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])) - 0.5)), 0)
            right = wp.min(int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])) - 0.5)), view.width - 1)
            top = wp.max(int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])) - 0.5)), 0)
            bottom = wp.min(int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])) - 0.5)), view.height - 1)
            for y in range(top, bottom + 1):
                for x in range(left, right + 1):
                    px = float(x) + 0.5
                    py = float(y) + 0.5
                    wa = ((c[0] - px) * (b[1] - py) - (b[0] - px) * (c[1] - py)) / area
                    wb = ((a[0] - px) * (c[1] - py) - (c[0] - px) * (a[1] - py)) / area
                    wc = 1.0 - wa - wb
                    if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                        inverse = wa * a[2] + wb * b[2] + wc * c[2]
                        if inverse > nearest[y, x]:
                            nearest[y, x] = inverse
                            image[y, x] = wa * colors[corner[0]] + wb * colors[corner[1]] + wc * colors[corner[2]]


@wp.func
def ground_point(view: View, x: float, y: float) -> wp.vec3:
    """Return ground coordinates seen at a sample [m] and their inverse depth [1/m]; 0 above the horizon."""
    ray = (
        view.forward
        + ((x - 0.5 * float(view.width)) * view.right + (0.5 * float(view.height) - y) * view.up) / view.focal
    )
    depth = (_GROUND_HEIGHT - view.eye[2]) / wp.min(ray[2], -1.0e-6)
    inverse = wp.where(ray[2] < -1.0e-5, 1.0 / depth, 0.0)
    return wp.vec3(view.eye[0] + depth * ray[0], view.eye[1] + depth * ray[1], inverse)


@wp.func
def triangle_wave(x: float) -> float:
    """Return the integral of the square wave of period 2, for a box filter."""
    return 2.0 * wp.abs(0.5 * x - wp.floor(0.5 * x) - 0.5)


@wp.func
def lines_integral(x: float) -> float:
    """Return the integral of the lines at whole numbers."""
    return wp.floor(x) * _LINE_SHARE + wp.min(x - wp.floor(x), _LINE_SHARE)


@wp.func
def checker(look: GroundLook, at: wp.vec2, footprint: wp.vec2) -> wp.vec3:
    """Return the ground's colour averaged over a pixel, ``at`` and ``footprint`` in squares."""
    low = at - 0.5 * footprint
    high = at + 0.5 * footprint
    sx = (triangle_wave(low[0]) - triangle_wave(high[0])) / footprint[0]
    sy = (triangle_wave(low[1]) - triangle_wave(high[1])) / footprint[1]
    color = wp.lerp(look.light, look.dark, 0.5 - 0.5 * sx * sy)
    lx = (lines_integral(high[0]) - lines_integral(low[0])) / footprint[0]
    ly = (lines_integral(high[1]) - lines_integral(low[1])) / footprint[1]
    return wp.lerp(color, look.line, lx + ly - lx * ly)


@wp.func
def shadow_at(look: GroundLook, opacity: wp.array2d[float], x: float, y: float) -> float:
    """Return the opacity of the shadow at a point of the ground [m], between texels."""
    size = opacity.shape[0]
    scale = float(size) / look.shadow_size
    u = (x - look.shadow_origin[0]) * scale - 0.5
    v = (y - look.shadow_origin[1]) * scale - 0.5
    result = float(0.0)
    if u >= 0.0 and v >= 0.0 and u < float(size - 1) and v < float(size - 1):
        i = int(u)
        j = int(v)
        fu = u - float(i)
        fv = v - float(j)
        result = (1.0 - fu) * ((1.0 - fv) * opacity[i, j] + fv * opacity[i, j + 1]) + fu * (
            (1.0 - fv) * opacity[i + 1, j] + fv * opacity[i + 1, j + 1]
        )
    return result


@wp.kernel
def resolve(
    # in
    view: View,
    look: GroundLook,
    opacity: wp.array2d[float],
    # in, out: cleared for the next picture
    nearest: wp.array2d[float],
    image: wp.array2d[wp.vec3],
    # out
    picture: wp.array3d[wp.uint8],  # (H, W, 3)
):
    """Average the samples of a pixel; where nothing was drawn, show the ground or the background."""
    row, column = wp.tid()
    x = float(column * SAMPLES) + 0.5 * float(SAMPLES)
    y = float(row * SAMPLES) + 0.5 * float(SAMPLES)
    back = wp.lerp(look.sky_top, look.sky_bottom, y / float(view.height))
    here = ground_point(view, x, y)
    if here[2] > 0.0:
        distance = wp.length(wp.vec2(here[0], here[1]) - look.center)
        share = wp.clamp((_FADE_END - distance) / (_FADE_END - _FADE_START), 0.0, 1.0)
        if share > 0.0:
            across = ground_point(view, x + float(SAMPLES), y)
            along = ground_point(view, x, y + float(SAMPLES))
            footprint = wp.vec2(
                wp.abs(across[0] - here[0]) + wp.abs(along[0] - here[0]),
                wp.abs(across[1] - here[1]) + wp.abs(along[1] - here[1]),
            )
            squares = wp.vec2(here[0], here[1]) / _SQUARE
            color = checker(look, squares, footprint / _SQUARE)
            back = wp.lerp(back, color, share * share * (3.0 - 2.0 * share))
            back = wp.lerp(back, look.shadow, shadow_at(look, opacity, here[0], here[1]))
    total = wp.vec3(0.0)
    for i in range(SAMPLES):
        for j in range(SAMPLES):
            r = row * SAMPLES + i
            c = column * SAMPLES + j
            if nearest[r, c] > here[2]:
                total += image[r, c]
            else:
                total += back
            nearest[r, c] = 0.0
    total = total / float(SAMPLES * SAMPLES)
    for channel in range(3):
        picture[row, column, channel] = wp.uint8(wp.clamp(total[channel] + 0.5, 0.0, 255.0))
