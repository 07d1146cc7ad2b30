"""Proxy of the skin: close to it, closed where garments are, of the right parts."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.avatar.body.asset import AvatarAsset, vertex_normals
from piavatar_envs.avatar.body.sampling import ClosedSurface
from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.cloth import proxy as proxies
from piavatar_envs.cloth.proxy import Proxy, curved, proxy_of


@pytest.fixture(scope="module")
def asset() -> AvatarAsset:
    return load_asset()


@pytest.fixture(scope="module")
def proxy(asset: AvatarAsset) -> Proxy:
    return proxy_of(asset)


def test_the_curved_proxy_is_close_to_the_skin(asset, proxy):
    skin = asset.vertices.astype(float)
    points = skin[proxy.keep]
    fine = np.isin(asset.skin_joints[:, 0], [joint_index(n) for n in ("pelvis", "spine1", "spine2", "spine3")])
    fine |= np.isin(
        asset.skin_joints[:, 0], [joint_index(f"{s}_{n}") for s in ("left", "right") for n in ("hip", "knee")]
    )
    _, triangle, coordinates = ClosedSurface(points, proxy.faces).query(skin[fine])
    triangles = proxy.faces[triangle]
    flat = np.einsum("kc,kcd->kd", coordinates, points[triangles])
    at, normal = curved(points, vertex_normals(points, proxy.faces), triangles, coordinates)
    error, of_flat = (((skin[fine] - place) * normal).sum(axis=1) for place in (at, flat))
    assert np.sqrt((error**2).mean()) < 1.7e-3 < 2.2e-3 < np.sqrt((of_flat**2).mean())
    assert abs(error.mean()) < 0.5e-3  # neither above nor below


def test_trunk_and_legs_are_closed_and_evenly_covered(asset, proxy):
    a, b = np.concatenate([proxy.faces, np.roll(proxy.faces, 1, axis=1), np.roll(proxy.faces, 2, axis=1)])[:, :2].T
    half = set(zip(a.tolist(), b.tolist(), strict=True))
    covered = proxies.TRUNK | proxies.LEFT_LEG | proxies.RIGHT_LEG
    open_edges = [(i, j) for i, j in half if (j, i) not in half and proxy.part[i] & covered and proxy.part[j] & covered]
    assert not open_edges
    at = asset.vertices[proxy.keep]
    length = np.linalg.norm(at[a] - at[b], axis=1)[(proxy.part[a] & covered > 0) & (proxy.part[b] & covered > 0)]
    assert np.percentile(length, 99) < 0.08


def test_parts_follow_the_bones(asset, proxy):
    at, part = asset.vertices[proxy.keep], proxy.part
    assert (part > 0).all() and (part <= proxies.ALL_PARTS).all()
    assert (at[part == proxies.LEFT_LEG][:, 0] > 0.0).all() and (at[part == proxies.RIGHT_LEG][:, 0] < 0.0).all()
    assert (at[part == proxies.HEAD][:, 2] > at[part == proxies.TRUNK][:, 2].mean()).all()
    both = part & (proxies.TRUNK | proxies.LEFT_ARM) == proxies.TRUNK | proxies.LEFT_ARM
    assert both.any()  # a shoulder
    for bit in proxies.PART_JOINTS:
        assert (part & bit > 0).sum() >= 4, bit


def test_the_proxy_as_an_asset_keeps_shapes(asset, proxy):
    parameters = asset.parameters(weight=0.7)
    small = proxy.of(asset)
    np.testing.assert_array_equal(small.shape(parameters).joints[:, :2], asset.shape(parameters).joints[:, :2])
    whole, few = asset.shape(parameters).vertices[proxy.keep], small.shape(parameters).vertices
    np.testing.assert_allclose(whole - whole[0], few - few[0], atol=2e-6)
    assert small.drawn.vertices.shape == (len(proxy.keep), 3)


def test_a_skin_of_fewer_vertices_is_kept_whole(asset):
    few = proxy_of(asset, 120)
    coarse = few.of(asset)
    assert len(proxy_of(coarse).keep) <= len(few.keep)
