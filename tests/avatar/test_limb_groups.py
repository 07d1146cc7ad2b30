"""Limb groups: every particle is in the right one, limbs hang together only at their seams."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from piavatar_envs.avatar.body.sampling import (
    LIMB_GROUPS,
    LINK_LENGTH,
    SEAM_WEIGHT,
    limb_group_of_joint,
    limb_groups,
    sample_particles,
    spacing_for,
)
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES, NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset

TORSO = LIMB_GROUPS.index("torso")


@pytest.fixture(scope="module")
def body():
    """Particles of the body at the coarse size, their groups and seams."""
    asset = load_asset()
    particles = sample_particles(asset, spacing_for(np.ptp(asset.vertices[:, 2]) / 32))
    return particles, *limb_groups(particles.skin_joints, particles.skin_weights)


def test_groups_of_the_joints():
    group = limb_group_of_joint()
    assert group.shape == (NUM_JOINTS,) and set(group) == set(range(len(LIMB_GROUPS)))
    for name in ("pelvis", "spine1", "spine2", "spine3", "neck", "head", "left_collar", "right_collar"):
        assert LIMB_GROUPS[group[joint_index(name)]] == "torso"
    for name in LIMB_GROUPS[1:]:
        assert [JOINT_NAMES[j] for j in np.flatnonzero(group == LIMB_GROUPS.index(name))] == list(BODY_PARTS[name])


def test_every_limb_grows_out_of_the_torso():
    """The only joints whose parent is in another group are the first of a limb, and that parent is in the torso."""
    group = limb_group_of_joint()
    first = [j for j in range(1, NUM_JOINTS) if group[j] != group[PARENTS[j]]]
    assert sorted(JOINT_NAMES[j] for j in first) == ["left_hip", "left_shoulder", "right_hip", "right_shoulder"]
    assert all(group[PARENTS[j]] == TORSO for j in first)


def weights_of(**parts: float):
    """One particle with the weights of some joints, filled up to four."""
    joints = [joint_index(name) for name in parts] + [0] * (4 - len(parts))
    return np.array([joints], np.int32), np.array([[*parts.values(), *[0.0] * (4 - len(parts))]], np.float32)


@pytest.mark.parametrize(
    ("parts", "group", "seam"),
    [
        ({"left_elbow": 1.0}, "left_arm", 0),
        ({"head": 0.5, "neck": 0.5}, "torso", 0),
        ({"left_collar": 0.6, "left_shoulder": 0.4}, "torso", 1),
        # the largest single weight is the pelvis's; the leg's two are larger together
        ({"pelvis": 0.4, "left_hip": 0.3, "left_knee": 0.3}, "left_leg", 1),
        ({"left_hip": 0.5, "right_hip": 0.47, "pelvis": 0.03}, "left_leg", 1),
        ({"right_shoulder": 0.951, "spine3": 0.049}, "right_arm", 0),
        ({"right_shoulder": 0.95, "spine3": 0.05}, "right_arm", 1),
        # two groups below the limit do not add up to a seam
        ({"spine3": 0.94, "left_shoulder": 0.03, "right_shoulder": 0.03}, "torso", 0),
        # an equal share goes to the group listed first, whatever the order of the weights
        ({"left_hip": 0.5, "pelvis": 0.5}, "torso", 1),
    ],
)
def test_group_and_seam_of_one_particle(parts, group, seam):
    index, at_seam = limb_groups(*weights_of(**parts))
    assert index.dtype == np.int32 and at_seam.dtype == np.float32
    assert LIMB_GROUPS[index[0]] == group
    assert at_seam[0] == seam
    assert SEAM_WEIGHT == 0.05  # the limit that the rows above stand on


def test_particles_lie_where_their_group_is(body):
    """A rigid bone particle is in its joint's group; the left limbs are on the left (+x)."""
    particles, group, _ = body
    bone = particles.bone >= 0
    assert np.array_equal(group[bone], limb_group_of_joint()[particles.bone[bone]])
    x, z = particles.rest_positions[:, 0], particles.rest_positions[:, 2]
    pelvis, neck = (load_asset().joints[joint_index(name), 2] for name in ("pelvis", "neck"))
    for index, name in enumerate(LIMB_GROUPS):
        if name.startswith("left"):
            assert x[group == index].min() > 0.0
        if name.startswith("right"):
            assert x[group == index].max() < 0.0
        if name.endswith("leg"):
            assert z[group == index].max() < pelvis + 0.12
    assert np.all(group[z > neck + 0.05] == TORSO)


def test_a_limb_hangs_on_the_torso_by_its_seam(body):
    """Wherever a limb and the torso are neighbours inside the body, seam particles of both are near."""
    particles, group, seam = body
    for index in range(1, len(LIMB_GROUPS)):
        links = particles.links[(group[particles.links] == index).sum(axis=1) == 1]
        assert len(links) > 10
        for side in (index, TORSO):
            near = cKDTree(particles.rest_positions[(group == side) & (seam > 0)])
            assert near.query(particles.rest_positions[links].mean(axis=1))[0].max() < LINK_LENGTH * particles.spacing


def test_hands_feet_and_head_are_no_seam(body):
    """What touches other parts of the body must be free of it."""
    particles, _, seam = body
    for name in ("left_wrist", "right_wrist", "left_ankle", "right_foot", "left_elbow", "left_knee", "head"):
        assert not seam[particles.skin_joints[:, 0] == joint_index(name)].any(), name
    assert 0.05 < seam.mean() < 0.4


def test_sides_are_mirror_images(body):
    """The lattice is as symmetric as the body, so both arms and both legs are as large."""
    group = body[1]
    counts = np.bincount(group, minlength=len(LIMB_GROUPS))
    assert abs(counts[1] - counts[2]) <= 0.02 * counts[1]
    assert abs(counts[3] - counts[4]) <= 0.02 * counts[3]
