"""Samples into pixels: colours of the surfaces and of the ground, depth and labels."""

from __future__ import annotations

import warp as wp

from piavatar_envs.render.ground import Ground, checker, ground_at, ground_share
from piavatar_envs.render.shadows import Grids, opacity_at
from piavatar_envs.render.views import View, ray_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Paint:
    """Colours of the surfaces, as in :class:`piavatar_envs.render.surfaces.Surfaces`."""

    albedo: wp.array2d[wp.vec3]
    uv: wp.array[wp.vec2]
    texture: wp.array[int]
    texels: wp.array3d[wp.uint8]
    texture_size: int
    subject: wp.array[int]


@wp.func
def to_srgb(light: float) -> float:
    """Return the sRGB value of linear light, within half a byte (three square roots in place of a power)."""
    a = wp.sqrt(wp.clamp(light, 0.0, 1.0))
    b = wp.sqrt(a)
    return wp.clamp(0.662002687 * a + 0.684122060 * b - 0.323583601 * wp.sqrt(b) - 0.0225411470 * light, 0.0, 1.0)


@wp.func
def to_linear(value: float) -> float:
    """Return the linear light of an sRGB value, within a hundredth (a cubic in place of a power)."""
    return value * (value * (value * 0.305306011 + 0.682171111) + 0.012522878)


@wp.func
def texel_at(texels: wp.array3d[wp.uint8], texture: int, cell: int) -> wp.vec3:
    """Return a texel, sRGB in [0, 255]."""
    return wp.vec3(
        float(texels[texture, cell, 0]), float(texels[texture, cell, 1]), float(texels[texture, cell, 2])
    )


@wp.func
def textured(paint: Paint, texture: int, uv: wp.vec2, texels_a_pixel: float) -> wp.vec3:
    """Return the linear base colour of a texture between the texels of the level that fits the pixels."""
    size = int(paint.texture_size)
    first = int(0)
    while size > 1 and texels_a_pixel * float(size * size) > 2.0 * float(paint.texture_size * paint.texture_size):
        first += size * size
        size = size // 2
    x = uv[0] * float(size) - 0.5
    y = uv[1] * float(size) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - float(column)
    fy = y - float(row)
    left = column & (size - 1)
    right = (column + 1) & (size - 1)
    top = first + (row & (size - 1)) * size
    bottom = first + ((row + 1) & (size - 1)) * size
    color = (1.0 - fy) * (
        (1.0 - fx) * texel_at(paint.texels, texture, top + left) + fx * texel_at(paint.texels, texture, top + right)
    ) + fy * (
        (1.0 - fx) * texel_at(paint.texels, texture, bottom + left)
        + fx * texel_at(paint.texels, texture, bottom + right)
    )
    color = color / 255.0
    return wp.vec3(to_linear(color[0]), to_linear(color[1]), to_linear(color[2]))


@wp.func
def shade(
    view: View,
    paint: Paint,
    row: int,
    triangle: int,
    corner: wp.vec3i,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    light_a: wp.vec4,
    light_b: wp.vec4,
    light_c: wp.vec4,
    x: float,
    y: float,
) -> wp.vec3:
    """Return the sRGB colour that a triangle shows at a pixel position.

    The corners' weights are those of the ray's intersection (T. Moeller and B. Trumbore, "Fast, minimum storage
    ray/triangle intersection", 1997).
    """
    ray = ray_of(view, x, y)
    side = b - a
    other = c - a
    across = wp.cross(ray, other)
    determinant = wp.dot(side, across)
    offset = view.eye - a
    scale = 1.0 / wp.where(wp.abs(determinant) > 1.0e-20, determinant, 1.0e-20)
    # A sample at the rim of a triangle seen edge-on would be far outside by rounding.
    wb = wp.clamp(wp.dot(offset, across) * scale, 0.0, 1.0)
    wc = wp.clamp(wp.dot(ray, wp.cross(offset, side)) * scale, 0.0, 1.0 - wb)
    wa = 1.0 - wb - wc
    light = wa * light_a + wb * light_b + wc * light_c
    texture = paint.texture[triangle]
    albedo = wp.vec3()
    if texture < 0:
        albedo = (
            wa * paint.albedo[row, corner[0]] + wb * paint.albedo[row, corner[1]] + wc * paint.albedo[row, corner[2]]
        )
    else:
        uv_a = paint.uv[corner[0]]
        uv_b = paint.uv[corner[1]]
        uv_c = paint.uv[corner[2]]
        at = a + wb * side + wc * other - view.eye
        depth = wp.dot(at, view.forward)
        size = float(paint.texture_size)
        u = uv_b - uv_a
        v = uv_c - uv_a
        of_texels = wp.abs(u[0] * v[1] - u[1] * v[0]) * size * size
        of_pixels = view.focal * view.focal * wp.abs(wp.dot(wp.cross(side, other), at)) / (depth * depth * depth)
        albedo = textured(
            paint, texture, wa * uv_a + wb * uv_b + wc * uv_c, of_texels / wp.max(of_pixels, 1.0e-9)
        )
    return wp.vec3(
        to_srgb(albedo[0] * light[0] + light[3]),
        to_srgb(albedo[1] * light[1] + light[3]),
        to_srgb(albedo[2] * light[2] + light[3]),
    )


@wp.func
def background(
    view: View, ground: Ground, center: wp.vec2, own: Grids, opacity: wp.array2d[float], c: int, at: wp.vec3,
    share: float, x: float, y: float,
) -> wp.vec3:  # fmt: skip
    """Return the sRGB colour of the ground or the sky at a pixel."""
    color = wp.lerp(ground.sky_top, ground.sky_bottom, y / float(view.height))
    if share > 0.0:
        color = wp.lerp(color, checker(ground, view, at, x, y), share)
        color = wp.lerp(color, ground.shadow, opacity_at(own, opacity, c, at[0], at[1]))
    return color


@wp.kernel
def resolve(
    # in
    first: int,
    samples: int,
    ground: Ground,
    paint: Paint,
    views: wp.array[View],
    centers: wp.array[wp.vec2],  # (N,)
    triangles: wp.array[wp.vec3i],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    light: wp.array2d[wp.vec4],  # (C, V)
    grids: wp.array[Grids],
    opacity: wp.array2d[float],
    # in, out: cleared for the next run
    keys: wp.array2d[wp.uint64],  # (C, samples)
    num_large: wp.array[int],
    # out
    color: wp.array3d[wp.vec3],  # sRGB in [0, 1], (N, H, W)
    nearest: wp.array3d[float],  # inverse depth [1/m], 0 where the sky is seen, (N, H, W)
    labels: wp.array3d[wp.uint8],
):
    """Average the samples of a pixel; where nothing was drawn, show the ground or the background."""
    c, row, column = wp.tid()
    n = first + c
    view = views[n]
    if row == 0 and column == 0:
        num_large[c] = 0
    x = float(column) + 0.5
    y = float(row) + 0.5
    at = ground_at(view, x, y)
    share = ground_share(at, centers[n])
    behind = wp.where(share > 0.0, at[2], 0.0)
    wide = samples * view.width
    corner_sample = samples * row * wide + samples * column
    total = wp.vec3()
    drawn = int(0)
    greatest = wp.uint64(0)
    for i in range(samples * samples):
        key = keys[c, corner_sample + (i // samples) * wide + i % samples]
        own = int(key & wp.uint64(0xFFFFFFFF))
        if own > 0 and wp.cast(wp.uint32(key >> wp.uint64(32)), float) > behind:
            greatest = wp.max(greatest, key)
            # A triangle is shaded once a pixel, amid the samples that show it.
            count = int(0)
            place = wp.vec2()
            is_first = bool(True)
            for j in range(samples * samples):
                other = keys[c, corner_sample + (j // samples) * wide + j % samples]
                if int(other & wp.uint64(0xFFFFFFFF)) == own:
                    if j < i:
                        is_first = False
                    if wp.cast(wp.uint32(other >> wp.uint64(32)), float) > behind:
                        count += 1
                        place += wp.vec2(float(j % samples), float(j // samples))
            if is_first:
                s = 1.0 / float(samples)
                px = float(column) + (place[0] / float(count) + 0.5) * s
                py = float(row) + (place[1] / float(count) + 0.5) * s
                t = own - 1
                corner = triangles[t]
                seen = shade(
                    view,
                    paint,
                    wp.min(n, paint.albedo.shape[0] - 1),
                    t,
                    corner,
                    vertices[n, corner[0]],
                    vertices[n, corner[1]],
                    vertices[n, corner[2]],
                    light[c, corner[0]],
                    light[c, corner[1]],
                    light[c, corner[2]],
                    px,
                    py,
                )
                total += float(count) * seen
                drawn += count
    missing = samples * samples - drawn
    if missing > 0:
        total += float(missing) * background(view, ground, centers[n], grids[c], opacity, c, at, share, x, y)
    for i in range(samples * samples):
        sample = corner_sample + (i // samples) * wide + i % samples
        if keys[c, sample] != wp.uint64(0):
            keys[c, sample] = wp.uint64(0)
    color[n, row, column] = total / float(samples * samples)
    front = int(greatest & wp.uint64(0xFFFFFFFF))
    nearest[n, row, column] = wp.where(front > 0, wp.cast(wp.uint32(greatest >> wp.uint64(32)), float), behind)
    if labels.shape[0] > 0:
        labels[n, row, column] = wp.uint8(wp.where(front > 0, paint.subject[wp.max(front - 1, 0)], 0))


@wp.kernel
def to_bytes(
    # in
    color: wp.array3d[wp.vec3],  # sRGB in [0, 1], (N, H, W)
    nearest: wp.array3d[float],  # [1/m]
    # out
    picture: wp.array4d[wp.uint8],  # (N, H, W, 3)
    depth: wp.array3d[float],  # [m], infinite in the sky
):
    """Round the colours to bytes, and turn inverse depths into depths."""
    n, row, column = wp.tid()
    seen = color[n, row, column]
    for channel in range(3):
        picture[n, row, column, channel] = wp.uint8(wp.clamp(255.0 * seen[channel] + 0.5, 0.0, 255.0))
    if depth.shape[0] > 0:
        depth[n, row, column] = 1.0 / nearest[n, row, column]
