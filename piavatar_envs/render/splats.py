"""Drawing of 3D Gaussians in Warp, for many pictures at once, over the picture of the meshes.

A Gaussian is projected by EWA splatting (Zwicker, Pfister, van Baar and Gross, "EWA volume splatting", 2001) and
blended front to back as in Kerbl, Kopanas, Leimkühler and Drettakis, "3D Gaussian splatting for real-time radiance
field rendering", ACM Trans. Graph. 42 (2023), eqs. 3 to 5. A low-pass of a pixel's size widens it and takes from its
opacity what it adds to its area, ``sqrt(det C / det(C + s I))`` with ``s`` of 0.1 px^2 (Yu, Chen, Huang, Sattler and
Geiger, "Mip-Splatting: alias-free 3D Gaussian splatting", CVPR 2024), so that a body is as wide in small pictures as in
large ones. Splats are sorted by the depth of their centres, equals by their index, so that a picture does not depend on
its place in a batch, nor on the schedule.

A pixel at the edge of a surface shows that surface and a backdrop beside it. Splats in front of the surface cover both,
and those behind it the backdrop alone.

Every launch and workspace has a size that is fixed when the painter is built. A GPU marks in a bit mask which of the
sorted splats reach which tile of 16 x 16 pixels, instead of listing the pairs, whose number changes with the view:
nothing can overflow. A CPU walks over the splats, and over the pixels of each.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.splats import FACTORS
from piavatar_envs.core.arrays import vec6, vec16
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.render.raster import NEAR
from piavatar_envs.render.views import View

wp.set_module_options({"enable_backward": False})

#: Most spherical harmonics of a colour: those of degree 3.
MAX_HARMONICS = 16
#: Pixels along each side of a tile, whose threads are a CUDA block.
TILE = 16
#: Most pictures that are sorted together: their number and 27 bits of depth are a key.
MAX_CHUNK = 32
#: Of the splats that are drawn together, and of the masks [bytes].
SPLAT_WORKSPACE, MASK_WORKSPACE = 2**28, 2**27
#: Of a projected splat: its record, key and index, the latter two twice [bytes].
_SPLAT_BYTES = 68
_DEPTH_BITS = 27

_TILE = wp.constant(TILE)
_PIXELS_OF_TILE = wp.constant(TILE * TILE)
_DEPTH_KEYS = wp.constant(wp.uint32(_DEPTH_BITS))
# Depths from 2^-5 m to 2^11 m have 16 exponents, so that their bits above those of the first need 27 bits.
_FURTHEST = wp.constant(2.0**11)
_NEAREST_BITS = wp.constant(wp.uint32(np.float32(2.0**-5).view(np.uint32)))
_LAST_KEY = wp.constant(wp.uint32(2**_DEPTH_BITS - 1))
# Variance that the reconstruction filter of a pixel adds [px^2].
_LOW_PASS = wp.constant(0.1)
_FACTORS = wp.constant(vec16(*FACTORS))
# The projection is linearised at most this many half pictures from its axis.
_WIDEST = wp.constant(1.3)
_MAX_ALPHA, _MIN_ALPHA = wp.constant(0.99), wp.constant(1.0 / 255.0)
_LOG_MIN_ALPHA = wp.constant(float(np.log(1.0 / 255.0)))
# Transmittance below which nothing more is blended.
_OPAQUE = wp.constant(1.0e-4)


class Canvas(Protocol):
    """Pictures of ``N`` cameras that splats are blended over."""

    views: wp.array  # View, (N,)
    color: wp.array  # vec3, sRGB in [0, 1], (N, H, W)
    nearest: wp.array  # inverse depth [1/m], 0 where nothing is, (N, H, W)
    coverage: wp.array  # share of the pixel of the surface that is nearest, (N, H, W)
    backdrop: wp.array  # vec4, sRGB and inverse depth beside it; the latter is that of ``nearest`` if nothing is
    labels: wp.array | None  # subjects, (N, H, W) uint8


@wp.struct
class Records:
    """Projected splats of some pictures, sorted front to back, each array ``(pictures, splats)``."""

    place: wp.array2d[wp.vec4]  # centre, half width and half height [px]; the latter are -1 out of sight
    shape: wp.array2d[wp.vec4]  # inverse covariance xx, xy, yy [1/px^2], and ln(opacity) without the low-pass
    share: wp.array2d[float]  # of its opacity, which the low-pass leaves
    tint: wp.array2d[wp.vec4]  # sRGB, and inverse depth [1/m]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return __ffs((int)bits) - 1;
#else
return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: wp.uint32) -> int:
    """Return the index of the lowest set bit; ``bits`` must not be 0."""
    ...


@wp.func
def harmonics_of(d: wp.vec3) -> vec16:
    """Return the real spherical harmonics of a unit vector, with the signs and the order of Kerbl et al. (2023)."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    terms = vec16(
        1.0,
        y,
        z,
        x,
        x * y,
        y * z,
        2.0 * zz - xx - yy,
        x * z,
        xx - yy,
        y * (3.0 * xx - yy),
        x * y * z,
        y * (4.0 * zz - xx - yy),
        z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        x * (4.0 * zz - xx - yy),
        z * (xx - yy),
        x * (xx - 3.0 * yy),
    )
    return wp.cw_mul(_FACTORS, terms)


@wp.func
def color_towards(harmonics: wp.array2d[wp.vec3], s: int, d: wp.vec3) -> wp.vec3:
    """Return the colour of splat ``s`` seen along a unit vector of its rest frame, not negative."""
    color = wp.vec3(0.5, 0.5, 0.5)
    values = harmonics_of(d)
    for k in range(harmonics.shape[1]):
        color += values[k] * harmonics[s, k]
    return wp.vec3(wp.max(color[0], 0.0), wp.max(color[1], 0.0), wp.max(color[2], 0.0))


@wp.func
def quadratic_form(covariance: vec6, a: wp.vec3, b: wp.vec3) -> float:
    """Return ``a^T C b`` of a symmetric matrix given as xx, xy, xz, yy, yz, zz."""
    return (
        a[0] * (covariance[0] * b[0] + covariance[1] * b[1] + covariance[2] * b[2])
        + a[1] * (covariance[1] * b[0] + covariance[3] * b[1] + covariance[4] * b[2])
        + a[2] * (covariance[2] * b[0] + covariance[4] * b[1] + covariance[5] * b[2])
    )


@wp.func
def is_before(depth: float) -> bool:
    """Return whether a depth [m] is one that is drawn; not that of a splat which is not a number."""
    return depth > NEAR and depth < _FURTHEST


@wp.kernel
def write_depth_keys(
    # in
    first: int,  # picture of row 0
    views: wp.array[View],
    means: wp.array2d[wp.vec3],  # [m], (N, S)
    # out
    keys: wp.array[wp.uint32],  # rows of S
    values: wp.array[int],
):
    """Write the keys that sort the splats by picture and depth, beside their indices."""
    row, s = wp.tid()
    view = views[first + row]
    depth = wp.dot(means[first + row, s] - view.eye, view.forward)
    key = _LAST_KEY
    if is_before(depth):
        key = wp.cast(depth, wp.uint32) - _NEAREST_BITS
    at = row * means.shape[1] + s
    keys[at] = (wp.uint32(row) << _DEPTH_KEYS) + key
    values[at] = s


@wp.kernel
def project_splats(
    # in
    first: int,
    views: wp.array[View],
    means: wp.array2d[wp.vec3],  # [m], (N, S)
    covariances: wp.array2d[vec6],  # [m^2], (N, S)
    turns: wp.array2d[wp.quat],  # from the rest frame to the world, (N, S)
    opacities: wp.array[float],  # (S,)
    harmonics: wp.array2d[wp.vec3],  # (S, K)
    order: wp.array[int],  # indices of the sorted splats, rows of S
    # out
    records: Records,
):
    """Project the splats in their order; those out of sight cover no pixel."""
    row, i = wp.tid()
    picture = first + row
    s = order[row * means.shape[1] + i]
    view = views[picture]
    offset = means[picture, s] - view.eye
    depth = wp.dot(offset, view.forward)
    opacity = opacities[s]
    place = wp.vec4(0.0, 0.0, -1.0, -1.0)
    shape = wp.vec4(0.0)
    tint = wp.vec4(0.0)
    share = float(0.0)
    if is_before(depth) and opacity >= _MIN_ALPHA:
        inverse = 1.0 / depth
        across = wp.dot(offset, view.right) * inverse
        down = -wp.dot(offset, view.up) * inverse
        half_width = 0.5 * float(view.width)
        half_height = 0.5 * float(view.height)
        widest = _WIDEST * half_width / view.focal
        highest = _WIDEST * half_height / view.focal
        # rows of the Jacobian of the projection (Kerbl et al. 2023, eq. 5), in world axes
        scale = view.focal * inverse
        jx = scale * (view.right - wp.clamp(across, -widest, widest) * view.forward)
        jy = -scale * (view.up + wp.clamp(down, -highest, highest) * view.forward)
        covariance = covariances[picture, s]
        xx = quadratic_form(covariance, jx, jx)
        xy = quadratic_form(covariance, jx, jy)
        yy = quadratic_form(covariance, jy, jy)
        unfiltered = wp.max(xx * yy - xy * xy, 0.0)
        xx += _LOW_PASS
        yy += _LOW_PASS
        determinant = xx * yy - xy * xy
        if determinant > 0.0 and determinant < 1.0e30:
            share = wp.sqrt(unfiltered / determinant)
            # beyond this ellipse alpha over share is below its least value; many faint splats make an opaque body
            reach = 2.0 * (wp.log(opacity) - _LOG_MIN_ALPHA)
            place = wp.vec4(
                half_width + view.focal * across,
                half_height + view.focal * down,
                wp.sqrt(reach * xx),
                wp.sqrt(reach * yy),
            )
            shape = wp.vec4(yy / determinant, -xy / determinant, xx / determinant, wp.log(opacity))
            towards = wp.quat_rotate_inv(turns[picture, s], wp.normalize(offset))
            color = color_towards(harmonics, s, towards)
            tint = wp.vec4(color[0], color[1], color[2], inverse)
    records.place[row, i] = place
    records.shape[row, i] = shape
    records.share[row, i] = share
    records.tint[row, i] = tint


@wp.func
def covered(place: wp.vec4, width: int, height: int) -> wp.vec4i:
    """Return first and last column, first and last row of the pixels whose centres a splat can reach."""
    w = float(width)
    h = float(height)
    return wp.vec4i(
        int(wp.ceil(wp.clamp(place[0] - place[2] - 0.5, 0.0, w))),
        int(wp.floor(wp.clamp(place[0] + place[2] - 0.5, -1.0, w - 1.0))),
        int(wp.ceil(wp.clamp(place[1] - place[3] - 0.5, 0.0, h))),
        int(wp.floor(wp.clamp(place[1] + place[3] - 0.5, -1.0, h - 1.0))),
    )


@wp.func
def alpha_at(place: wp.vec4, shape: wp.vec4, x: float, y: float) -> float:
    """Return the opacity of a splat at a point of the picture (Kerbl et al. 2023, eq. 4), over its share."""
    dx = x - place[0]
    dy = y - place[1]
    exponent = shape[3] - 0.5 * (shape[0] * dx * dx + shape[2] * dy * dy) - shape[1] * dx * dy
    result = float(0.0)
    if exponent >= _LOG_MIN_ALPHA:
        result = wp.min(wp.exp(exponent), _MAX_ALPHA)
    return result


@wp.struct
class Blend:
    """Part of a splat in the light of a pixel."""

    kind: int  # 0 where it does not reach the pixel, -1 where neither it nor what follows is blended
    light: wp.vec3  # that it adds
    left: float  # transmittance behind it
    in_front: bool  # of the pixel's surface


@wp.func
def blend(
    records: Records,
    row: int,
    i: int,
    x: float,
    y: float,
    transmittance: float,
    surface: float,
    behind: float,
    beside: float,
) -> Blend:
    """Return how a sorted splat is blended at a point of the picture, behind those with this transmittance.

    ``surface`` and ``behind`` are inverse depths of the pixel's surface and of what is ``beside`` it, a share [1/m].
    """
    result = Blend()
    alpha = alpha_at(records.place[row, i], records.shape[row, i], x, y)
    if alpha > 0.0:
        alpha *= records.share[row, i]
        tint = records.tint[row, i]
        result.left = transmittance * (1.0 - alpha)
        if tint[3] < behind or result.left < _OPAQUE:
            result.kind = -1
        else:
            result.kind = 1
            result.in_front = tint[3] >= surface
            share = transmittance * alpha * wp.where(result.in_front, 1.0, beside)
            result.light = share * wp.vec3(tint[0], tint[1], tint[2])
    return result


@wp.kernel
def mark_tiles(
    # in
    place: wp.array2d[wp.vec4],
    width: int,
    height: int,
    first_row: int,  # of tiles
    # out
    masks: wp.array3d[wp.uint32],  # (pictures, tiles, words of 32 sorted splats)
):
    """Set the bits of the splats that reach each tile of some rows of tiles."""
    row, word = wp.tid()
    tiles_across = (width + _TILE - 1) // _TILE
    last_row = first_row + masks.shape[1] // tiles_across - 1
    for tile in range(masks.shape[1]):
        masks[row, tile, word] = wp.uint32(0)
    for b in range(32):
        i = 32 * word + b
        if i < place.shape[1]:
            pixels = covered(place[row, i], width, height)
            if pixels[0] <= pixels[1] and pixels[2] <= pixels[3]:
                for y in range(wp.max(pixels[2] // _TILE, first_row), wp.min(pixels[3] // _TILE, last_row) + 1):
                    for x in range(pixels[0] // _TILE, pixels[1] // _TILE + 1):
                        tile = (y - first_row) * tiles_across + x
                        masks[row, tile, word] = masks[row, tile, word] | (wp.uint32(1) << wp.uint32(b))


@wp.kernel
def mark_words(
    # in
    masks: wp.array3d[wp.uint32],
    # out
    words: wp.array3d[wp.uint32],  # (pictures, tiles, words of 32 words)
):
    """Set the bits of the words that are not empty, so that a tile skips 1,024 splats at once."""
    row, tile, at = wp.tid()
    bits = wp.uint32(0)
    for b in range(32):
        word = 32 * at + b
        if word < masks.shape[2] and masks[row, tile, word] != wp.uint32(0):
            bits = bits | (wp.uint32(1) << wp.uint32(b))
    words[row, tile, at] = bits


@wp.func
def put_in_front(
    row: int,
    picture: int,
    y: int,
    x: int,
    front: int,
    records: Records,
    subjects: wp.array[wp.uint8],
    order: wp.array[int],
    nearest: wp.array3d[float],
    labels: wp.array3d[wp.uint8],
):
    """Write depth and subject of the sorted splat that takes half of the light, unless it is -1."""
    if front >= 0:
        nearest[picture, y, x] = records.tint[row, front][3]
        if labels.shape[0] > 0:
            labels[picture, y, x] = subjects[order[row * records.tint.shape[1] + front]]


@wp.func
def laid_over(
    light: wp.vec3, before_surface: float, transmittance: float, color: wp.vec3, beside: float, backdrop: wp.vec4
) -> wp.vec3:
    """Return the colour of a pixel under splats, of which those behind its surface dim the backdrop beside it only."""
    dimmed = beside * (before_surface - transmittance)
    return light + before_surface * color - dimmed * wp.vec3(backdrop[0], backdrop[1], backdrop[2])


@wp.kernel
def blend_tiles(
    # in
    first: int,
    width: int,
    height: int,
    first_row: int,
    masks: wp.array3d[wp.uint32],
    words: wp.array3d[wp.uint32],
    records: Records,
    subjects: wp.array[wp.uint8],
    order: wp.array[int],
    coverage: wp.array3d[float],
    backdrop: wp.array3d[wp.vec4],
    # in, out
    color: wp.array3d[wp.vec3],
    nearest: wp.array3d[float],
    labels: wp.array3d[wp.uint8],
):
    """Blend the splats of a tile over the picture, a pixel a thread and a tile a CUDA block."""
    thread = wp.tid()
    block = thread // _PIXELS_OF_TILE
    row = block // masks.shape[1]
    tile = block - row * masks.shape[1]
    tiles_across = (width + _TILE - 1) // _TILE
    # a warp has 8 x 4 pixels: few splats reach a part of them only
    lane = thread % 32
    warp = (thread // 32) % 8
    x = _TILE * (tile % tiles_across) + 8 * (warp % 2) + lane % 8
    y = _TILE * (first_row + tile // tiles_across) + 4 * (warp // 2) + lane // 8
    if x < width and y < height:
        picture = first + row
        center = wp.vec2(float(x) + 0.5, float(y) + 0.5)
        surface = nearest[picture, y, x]
        behind = backdrop[picture, y, x][3]
        beside = 1.0 - coverage[picture, y, x]
        light = wp.vec3(0.0)
        transmittance = float(1.0)
        before_surface = float(1.0)
        front = int(-1)
        at = int(0)
        while at < words.shape[2]:
            some = words[row, tile, at]
            while some != wp.uint32(0):
                word = 32 * at + lowest_bit(some)
                some = some & (some - wp.uint32(1))
                bits = masks[row, tile, word]
                while bits != wp.uint32(0):
                    i = 32 * word + lowest_bit(bits)
                    bits = bits & (bits - wp.uint32(1))
                    place = records.place[row, i]
                    if wp.abs(center[0] - place[0]) <= place[2] and wp.abs(center[1] - place[1]) <= place[3]:
                        part = blend(records, row, i, center[0], center[1], transmittance, surface, behind, beside)
                        if part.kind < 0:
                            bits = wp.uint32(0)
                            some = wp.uint32(0)
                            at = words.shape[2]
                        elif part.kind > 0:
                            if part.in_front:
                                before_surface = part.left
                                if transmittance >= 0.5 and part.left < 0.5:
                                    front = i
                            light += part.light
                            transmittance = part.left
            at += 1
        color[picture, y, x] = laid_over(
            light, before_surface, transmittance, color[picture, y, x], beside, backdrop[picture, y, x]
        )
        put_in_front(row, picture, y, x, front, records, subjects, order, nearest, labels)


@wp.kernel
def blend_splats(
    # in
    first: int,
    records: Records,
    nearest: wp.array3d[float],
    coverage: wp.array3d[float],
    backdrop: wp.array3d[wp.vec4],
    # out
    light: wp.array3d[wp.vec4],  # colour, and transmittance: its negative where nothing more is blended
    before_surface: wp.array3d[float],  # transmittance of the splats in front of the surface
    front: wp.array3d[int],  # sorted splat that takes half of the light, or -1
):
    """Blend the splats of a picture one after another, a picture a thread."""
    row = wp.tid()
    height = light.shape[1]
    width = light.shape[2]
    for y in range(height):
        for x in range(width):
            light[row, y, x] = wp.vec4(0.0, 0.0, 0.0, 1.0)
            before_surface[row, y, x] = 1.0
            front[row, y, x] = -1
    for i in range(records.place.shape[1]):
        place = records.place[row, i]
        pixels = covered(place, width, height)
        for y in range(pixels[2], pixels[3] + 1):
            for x in range(pixels[0], pixels[1] + 1):
                before = light[row, y, x]
                if before[3] > 0.0:
                    part = blend(
                        records,
                        row,
                        i,
                        float(x) + 0.5,
                        float(y) + 0.5,
                        before[3],
                        nearest[first + row, y, x],
                        backdrop[first + row, y, x][3],
                        1.0 - coverage[first + row, y, x],
                    )
                    if part.kind < 0:
                        light[row, y, x] = wp.vec4(before[0], before[1], before[2], -before[3])
                    elif part.kind > 0:
                        if part.in_front:
                            before_surface[row, y, x] = part.left
                            if before[3] >= 0.5 and part.left < 0.5:
                                front[row, y, x] = i
                        light[row, y, x] = wp.vec4(
                            before[0] + part.light[0],
                            before[1] + part.light[1],
                            before[2] + part.light[2],
                            part.left,
                        )


@wp.kernel
def lay_over(
    # in
    first: int,
    light: wp.array3d[wp.vec4],
    before_surface: wp.array3d[float],
    front: wp.array3d[int],
    records: Records,
    subjects: wp.array[wp.uint8],
    order: wp.array[int],
    coverage: wp.array3d[float],
    backdrop: wp.array3d[wp.vec4],
    # in, out
    color: wp.array3d[wp.vec3],
    nearest: wp.array3d[float],
    labels: wp.array3d[wp.uint8],
):
    """Lay the blended splats over the picture."""
    row, y, x = wp.tid()
    own = light[row, y, x]
    picture = first + row
    color[picture, y, x] = laid_over(
        wp.vec3(own[0], own[1], own[2]),
        before_surface[row, y, x],
        wp.abs(own[3]),
        color[picture, y, x],
        1.0 - coverage[picture, y, x],
        backdrop[picture, y, x],
    )
    put_in_front(row, picture, y, x, front[row, y, x], records, subjects, order, nearest, labels)


class SplatPainter:
    """Draws the same ``S`` Gaussians, moved, in each of ``N`` pictures.

    Attributes:
        means: centres [m], vec3 ``(N, S)``; to be written before each picture, as the next two.
        covariances: xx, xy, xz, yy, yz, zz [m^2], ``(N, S)``.
        turns: rotations from the frame of the colours to the world, ``(N, S)``.
        opacities: in [0, 1], ``(S,)``.
        harmonics: of the colours, vec3 ``(S, K)``, ``K`` of 1, 4, 9 or 16: ``0.5 + sum Y_k c_k``.
        subjects: labels, ``(S,)`` uint8.
    """

    def __init__(
        self,
        opacities: np.ndarray,
        harmonics: np.ndarray,
        num_pictures: int,
        height: int,
        width: int,
        device: str,
        *,
        motion: tuple[wp.array, wp.array, wp.array] | None = None,
        subjects: np.ndarray | None = None,
        tiled: bool | None = None,
    ) -> None:
        """Allocate all arrays.

        Args:
            opacities: of the splats, in [0, 1], shape ``(S,)``.
            harmonics: coefficients of the colours, shape ``(S, K, 3)``.
            num_pictures: ``N``.
            height: of a picture [px].
            width: of a picture [px].
            device: the device to draw on.
            motion: arrays to read means, covariances and turns from; by default own ones.
            subjects: labels of the splats, shape ``(S,)``; 0 by default.
            tiled: whether to draw by tiles; by default on a GPU.

        Raises:
            ValueError: shapes that do not fit together, or an opacity outside [0, 1].
        """
        count = len(opacities)
        if np.shape(harmonics) not in [(count, k, 3) for k in (1, 4, 9, MAX_HARMONICS)] or count == 0:
            raise ValueError(f"harmonics of shape {np.shape(harmonics)}; give ({count}, K, 3), K = 1, 4, 9 or 16")
        if not ((np.asarray(opacities) >= 0.0) & (np.asarray(opacities) <= 1.0)).all():
            raise ValueError(f"opacities from {np.min(opacities)} to {np.max(opacities)}; give them in [0, 1]")
        self.num_pictures, self.height, self.width = num_pictures, height, width
        self.device, self.num_splats = device, count
        self.opacities = wp.array(np.asarray(opacities), dtype=float, device=device)
        self.harmonics = wp.array(np.asarray(harmonics), dtype=wp.vec3, device=device)
        subjects = np.zeros(count) if subjects is None else subjects
        self.subjects = wp.array(np.asarray(subjects, np.uint8), dtype=wp.uint8, device=device)
        rows = (num_pictures, count)
        self.means, self.covariances, self.turns = motion or (
            wp.zeros(rows, dtype=wp.vec3, device=device),
            wp.zeros(rows, dtype=vec6, device=device),
            wp.array(np.tile(np.float32([0, 0, 0, 1]), (*rows, 1)), dtype=wp.quat, device=device),
        )
        self.chunk = max(1, min(MAX_CHUNK, num_pictures, SPLAT_WORKSPACE // (_SPLAT_BYTES * count)))
        self._keys = wp.zeros(2 * self.chunk * count, dtype=wp.uint32, device=device)
        self._order = wp.zeros(2 * self.chunk * count, dtype=int, device=device)
        self._records = Records()
        for name in ("place", "shape", "tint"):
            setattr(self._records, name, wp.zeros((self.chunk, count), dtype=wp.vec4, device=device))
        self._records.share = wp.zeros((self.chunk, count), dtype=float, device=device)
        self.tiled = wp.get_device(device).is_cuda if tiled is None else tiled
        if self.tiled:
            across, words = -(-width // TILE), -(-count // 32)
            self.tile_rows = max(1, min(-(-height // TILE), MASK_WORKSPACE // (4 * words * across * self.chunk)))
            shape = (self.chunk, self.tile_rows * across)
            self._masks = wp.zeros((*shape, words), dtype=wp.uint32, device=device)
            self._words = wp.zeros((*shape, -(-words // 32)), dtype=wp.uint32, device=device)
        else:
            shape = (self.chunk, height, width)
            self._light = wp.zeros(shape, dtype=wp.vec4, device=device)
            self._before_surface = wp.zeros(shape, dtype=float, device=device)
            self._front = wp.zeros(shape, dtype=int, device=device)

    def record(self, graph: LaunchGraph, canvas: Canvas) -> None:
        """Append the launches that blend the splats over the pictures of a canvas.

        ``canvas.nearest`` and ``canvas.labels`` become those of the splat that takes half of the light, where there is
        one.
        """
        labels = wp.zeros((0, 0, 0), dtype=wp.uint8, device=self.device) if canvas.labels is None else canvas.labels
        open_share = [canvas.coverage, canvas.backdrop]
        out = [canvas.color, canvas.nearest, labels]
        for first in range(0, self.num_pictures, self.chunk):
            rows = min(self.chunk, self.num_pictures - first)
            splats = (rows, self.num_splats)
            graph.launch(write_depth_keys, splats, [first, canvas.views, self.means], [self._keys, self._order])
            bits = _DEPTH_BITS + (rows - 1).bit_length()
            graph.sort_pairs(self._keys, self._order, rows * self.num_splats, bits)
            motion = [self.means, self.covariances, self.turns, self.opacities, self.harmonics]
            graph.launch(project_splats, splats, [first, canvas.views, *motion, self._order], [self._records])
            if self.tiled:
                self._record_tiles(graph, first, rows, open_share, out)
            else:
                blended = [self._light, self._before_surface, self._front]
                graph.launch(blend_splats, rows, [first, self._records, canvas.nearest, *open_share], blended)
                pixels, kinds = (rows, self.height, self.width), [self.subjects, self._order]
                graph.launch(lay_over, pixels, [first, *blended, self._records, *kinds, *open_share], out)

    def _record_tiles(
        self, graph: LaunchGraph, first: int, rows: int, open_share: list[wp.array], out: list[wp.array]
    ) -> None:
        size = [self.width, self.height]
        tiles, words = self._masks.shape[1:]
        kinds = [self.subjects, self._order]
        for first_row in range(0, -(-self.height // TILE), self.tile_rows):
            graph.launch(mark_tiles, (rows, words), [self._records.place, *size, first_row], [self._masks])
            graph.launch(mark_words, (rows, tiles, self._words.shape[2]), [self._masks], [self._words])
            graph.launch(
                blend_tiles,
                rows * tiles * TILE * TILE,
                [first, *size, first_row, self._masks, self._words, self._records, *kinds, *open_share],
                out,
                block_dim=TILE * TILE,
            )
