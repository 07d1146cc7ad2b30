"""Samples into pixels: colours of the surfaces and of the ground, depth and labels."""

from __future__ import annotations

import warp as wp

from piavatar_envs.render.ground import Ground, checker, ground_at, ground_share
from piavatar_envs.render.shading import to_srgb
from piavatar_envs.render.shadows import Grids, opacity_at
from piavatar_envs.render.texels import level_of, texels_around
from piavatar_envs.render.views import View, ray_at, rays_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Paint:
    """Textures and labels of the surfaces, as in :class:`piavatar_envs.render.surfaces.Surfaces`."""

    uv: wp.array[wp.vec2]
    texture: wp.array[int]
    texels: wp.array3d[wp.uint8]
    wraps: wp.array2d[int]
    texture_size: int
    albedo: wp.array2d[wp.vec3]
    subject: wp.array[int]


@wp.func
def to_linear(value: float) -> float:
    """Return the linear light of an sRGB value, within a hundredth (a cubic in place of a power)."""
    return value * (value * (value * 0.305306011 + 0.682171111) + 0.012522878)


@wp.func
def texel_at(texels: wp.array3d[wp.uint8], texture: int, cell: int) -> wp.vec3:
    """Return a texel, sRGB in [0, 255]."""
    return wp.vec3(float(texels[texture, cell, 0]), float(texels[texture, cell, 1]), float(texels[texture, cell, 2]))


@wp.func
def textured(paint: Paint, texture: int, uv: wp.vec2, texels_a_pixel: float) -> wp.vec3:
    """Return the linear base colour of a texture between the texels of the level that fits the pixels."""
    around = texels_around(level_of(paint.texture_size, texels_a_pixel), paint.wraps, texture, uv)
    fx = around.across
    fy = around.down
    color = (1.0 - fy) * (
        (1.0 - fx) * texel_at(paint.texels, texture, around.upper_left)
        + fx * texel_at(paint.texels, texture, around.upper_right)
    ) + fy * (
        (1.0 - fx) * texel_at(paint.texels, texture, around.lower_left)
        + fx * texel_at(paint.texels, texture, around.lower_right)
    )
    color = color / 255.0
    return wp.vec3(to_linear(color[0]), to_linear(color[1]), to_linear(color[2]))


@wp.func
def weights_of(eye: wp.vec3, ray: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Return the weights of a triangle's corners where a ray meets it.

    T. Moeller and B. Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
    """
    side = b - a
    other = c - a
    across = wp.cross(ray, other)
    determinant = wp.dot(side, across)
    offset = eye - a
    scale = 1.0 / wp.where(wp.abs(determinant) > 1.0e-20, determinant, 1.0e-20)
    # A sample at the rim of a triangle seen edge-on would be far outside by rounding.
    wb = wp.clamp(wp.dot(offset, across) * scale, 0.0, 1.0)
    wc = wp.clamp(wp.dot(ray, wp.cross(offset, side)) * scale, 0.0, 1.0 - wb)
    return wp.vec3(1.0 - wb - wc, wb, wc)


@wp.func
def shade_texture(
    view: View, paint: Paint, texture: int, corner: wp.vec3i, a: wp.vec3, b: wp.vec3, c: wp.vec3, weights: wp.vec3,
    tint: wp.vec3, light: wp.vec4,
) -> wp.vec3:  # fmt: skip
    """Return the sRGB colour that a textured triangle of a tint shows where its corners have these weights."""
    uv_a = paint.uv[corner[0]]
    uv_b = paint.uv[corner[1]]
    uv_c = paint.uv[corner[2]]
    at = weights[0] * a + weights[1] * b + weights[2] * c - view.eye
    depth = wp.dot(at, view.forward)
    size = float(paint.texture_size)
    u = uv_b - uv_a
    v = uv_c - uv_a
    of_texels = wp.abs(u[0] * v[1] - u[1] * v[0]) * size * size
    of_pixels = view.focal * view.focal * wp.abs(wp.dot(wp.cross(b - a, c - a), at)) / (depth * depth * depth)
    uv = weights[0] * uv_a + weights[1] * uv_b + weights[2] * uv_c
    albedo = wp.cw_mul(tint, textured(paint, texture, uv, of_texels / wp.max(of_pixels, 1.0e-9)))
    return wp.vec3(
        to_srgb(albedo[0] * light[0] + light[3]),
        to_srgb(albedo[1] * light[1] + light[3]),
        to_srgb(albedo[2] * light[2] + light[3]),
    )


@wp.func_native("return keys.data[(size_t)keys.shape[1] * c + sample];")
def key_at(keys: wp.array2d[wp.uint64], c: int, sample: int) -> wp.uint64:
    """Return ``keys[c, sample]``."""
    ...


@wp.func_native("""
const uint64_t* own = keys.data + (size_t)keys.shape[1] * c + corner;
uint64_t greatest = 0;
for (int i = 0; i < samples; ++i)
    for (int j = 0; j < samples; ++j)
        greatest = own[i * wide + j] > greatest ? own[i * wide + j] : greatest;
return greatest;
""")
def greatest_key(keys: wp.array2d[wp.uint64], c: int, corner: int, wide: int, samples: int) -> wp.uint64:
    """Return the greatest key of a pixel, the nearest, from that of its first sample on, ``wide`` in a row."""
    ...


@wp.func
def triangle_of(key: wp.uint64) -> int:
    """Return one more than the triangle of a sample's key; 0 where nothing is drawn."""
    return int(key & wp.uint64(0xFFFFFFFF))


@wp.func
def inverse_depth_of(key: wp.uint64) -> float:
    """Return the inverse depth of a sample's key [1/m]; 0 where nothing is drawn."""
    return wp.cast(wp.uint32(key >> wp.uint64(32)), float)


@wp.func
def write_pixel(
    n: int, pixel: int, color: wp.vec3, inverse_depth: float, picture: wp.array2d[wp.uint8], depth: wp.array2d[float]
):
    """Round a colour to bytes, and turn an inverse depth into a depth, where depths are kept."""
    for channel in range(3):
        picture[n, 3 * pixel + channel] = wp.uint8(wp.clamp(255.0 * color[channel] + 0.5, 0.0, 255.0))
    if depth.shape[0] > 0:
        depth[n, pixel] = 1.0 / inverse_depth


@wp.kernel
def resolve(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (C,)
    first: int,
    threads: int,
    samples: int,
    ground: Ground,
    paint: Paint,
    views: wp.array[View],
    centers: wp.array[wp.vec2],  # (N,)
    triangles: wp.array[wp.vec3i],
    vertices: wp.array2d[wp.vec3],  # [m], (N, V)
    light: wp.array2d[wp.vec4],  # (C, V)
    lit: wp.array2d[wp.vec3],
    grids: wp.array[Grids],
    opacity: wp.array2d[float],
    # in, out: cleared for the next run
    keys: wp.array2d[wp.uint64],  # (C, samples)
    num_large: wp.array[int],
    # out
    color: wp.array2d[wp.vec3],  # sRGB in [0, 1], (N, H * W)
    nearest: wp.array2d[float],  # inverse depth [1/m], 0 where the sky is seen, (N, H * W)
    labels: wp.array2d[wp.uint8],
    picture: wp.array2d[wp.uint8],  # (N, H * W * 3)
    depth: wp.array2d[float],  # [m], infinite in the sky
    coverage: wp.array2d[float],
    backdrop: wp.array2d[wp.vec4],
):
    """Average the samples of a pixel; where nothing was drawn, show the ground or the background.

    Without layers, which need ``coverage``, the averages become bytes at once.
    """
    c, thread = wp.tid()
    if not drawn[c]:
        return
    n = first + c
    view = views[n]
    own = grids[c]
    center = centers[n]
    rays = rays_of(view)
    fall = 1.0 / float(view.height)
    wide = samples * view.width
    of_pixel = samples * samples
    spacing = 1.0 / float(samples)
    if thread == 0:
        num_large[c] = 0
    for pixel in range(thread, view.height * view.width, threads):
        row = pixel // view.width
        column = pixel - row * view.width
        corner_sample = samples * (row * wide + column)
        greatest = greatest_key(keys, c, corner_sample, wide, samples)
        x = float(column) + 0.5
        y = float(row) + 0.5
        ray = ray_at(rays, x, y)
        at = ground_at(view.eye, ray)
        share = ground_share(at, center)
        behind = wp.where(share > 0.0, at[2], 0.0)
        total = wp.vec3()
        missing = of_pixel
        # samples of surfaces beside the nearest one
        others = wp.vec3()
        num_others = int(0)
        beside = behind
        label = int(0)
        in_front = wp.max(inverse_depth_of(greatest), behind)
        if inverse_depth_of(greatest) > behind:
            label = paint.subject[triangle_of(greatest) - 1]
        while inverse_depth_of(greatest) > behind:
            # Every triangle is shaded once a pixel, amid the samples that show it; they are cleared on the way.
            t = triangle_of(greatest) - 1
            inverse = inverse_depth_of(greatest)
            greatest = wp.uint64(0)
            count = int(0)
            place = wp.vec2()
            for i in range(samples):
                for j in range(samples):
                    sample = corner_sample + i * wide + j
                    key = key_at(keys, c, sample)
                    if triangle_of(key) != t + 1:
                        greatest = wp.max(greatest, key)
                    else:
                        if inverse_depth_of(key) > behind:
                            count += 1
                            place += wp.vec2(float(j), float(i))
                        keys[c, sample] = wp.uint64(0)
            corner = triangles[t]
            px = float(column) + (place[0] / float(count) + 0.5) * spacing
            py = float(row) + (place[1] / float(count) + 0.5) * spacing
            p = vertices[n, corner[0]]
            q = vertices[n, corner[1]]
            r = vertices[n, corner[2]]
            weights = weights_of(view.eye, ray_at(rays, px, py), p, q, r)
            seen = weights[0] * lit[c, corner[0]] + weights[1] * lit[c, corner[1]] + weights[2] * lit[c, corner[2]]
            texture = paint.texture[t]
            if texture >= 0:
                own_light = (
                    weights[0] * light[c, corner[0]]
                    + weights[1] * light[c, corner[1]]
                    + weights[2] * light[c, corner[2]]
                )
                a = wp.min(n, paint.albedo.shape[0] - 1)
                tint = (
                    weights[0] * paint.albedo[a, corner[0]]
                    + weights[1] * paint.albedo[a, corner[1]]
                    + weights[2] * paint.albedo[a, corner[2]]
                )
                seen = shade_texture(view, paint, texture, corner, p, q, r, weights, tint, own_light)
            total += float(count) * seen
            missing -= count
            if paint.subject[t] != label:
                others += float(count) * seen
                num_others += count
                beside = wp.max(beside, inverse)
        if greatest != wp.uint64(0):
            for i in range(samples):
                for j in range(samples):
                    keys[c, corner_sample + i * wide + j] = wp.uint64(0)
        if missing > 0:
            back = wp.lerp(ground.sky_top, ground.sky_bottom, y * fall)
            if share > 0.0:
                back = wp.lerp(back, checker(ground, rays, view.eye, ray, at), share)
                back = wp.lerp(back, ground.shadow, opacity_at(own, opacity, c, at[0], at[1]))
            total += float(missing) * back
            others += float(missing) * back
        mean_color = total * (spacing * spacing)
        color[n, pixel] = mean_color
        nearest[n, pixel] = in_front
        if labels.shape[0] > 0:
            labels[n, pixel] = wp.uint8(label)
        if coverage.shape[0] > 0:
            num_beside = missing + num_others
            if num_beside == 0:
                beside = in_front
            mean = others / wp.max(float(num_beside), 1.0)
            coverage[n, pixel] = 1.0 - float(num_beside) / float(of_pixel)
            backdrop[n, pixel] = wp.vec4(mean[0], mean[1], mean[2], beside)
        else:
            write_pixel(n, pixel, mean_color, in_front, picture, depth)


@wp.kernel
def to_bytes(
    # in
    drawn: wp.array[wp.bool],  # pictures that change, (N,)
    threads: int,
    color: wp.array2d[wp.vec3],  # sRGB in [0, 1], (N, H * W)
    nearest: wp.array2d[float],  # [1/m]
    # out
    picture: wp.array2d[wp.uint8],  # (N, H * W * 3)
    depth: wp.array2d[float],  # [m], infinite in the sky
):
    """Round the colours, over which layers were drawn, to bytes, and turn inverse depths into depths."""
    n, thread = wp.tid()
    if not drawn[n]:
        return
    for pixel in range(thread, color.shape[1], threads):
        write_pixel(n, pixel, color[n, pixel], nearest[n, pixel], picture, depth)
