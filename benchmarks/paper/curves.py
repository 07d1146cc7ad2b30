"""Measurements over time for the figures of the paper: arrays ``(T,)`` by name and unit, from the course of an act."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from benchmarks.paper import acts
from benchmarks.paper.measures import belly_flesh, near, overlap_volume
from benchmarks.paper.stage import Course
from piavatar_envs.avatar.body.skeleton import BODY_PARTS
from piavatar_envs.core.arrays import matrices_of
from piavatar_envs.render.quantities import distortion

Curves = dict[str, np.ndarray]
#: Distances from where a blow falls, between which the deformation is averaged [m].
SHELLS = (0.0, 0.1, 0.2, 0.3, 0.4)


def ball(course: Course) -> Curves:
    """Return speed and dent of the object that is thrown, and the impulse that it gives in each control step."""
    impulse = np.linalg.norm(course.impulse[:, :, 1].sum(1), axis=1)
    return {
        "object_speed_m_s": np.linalg.norm(course.speed[:, 0], axis=1),
        "object_dent_mm": 1e3 * course.dent[:, 0],
        "impulse_n_s": impulse,
    }


def belly(course: Course) -> Curves:
    """Return the mean dent of the belly, the bend of trunk and legs, and the speed of the ball."""
    return {
        "mean_belly_dent_mm": 1e3 * course.displacements(near(course, acts.BELLY)).mean(1),
        "trunk_and_legs_deg": course.errors_of(
            "left_hip", "left_knee", "right_hip", "right_knee", "spine1", "spine2", "spine3"
        ),
        "ball_speed_m_s": np.linalg.norm(course.speed[:, 0], axis=1),
    }


def spread(course: Course) -> Curves:
    """Return the mean ``|F - R|`` of flesh in shells around where the ball hits."""
    rest = course.stage.simulation.flesh[0].points.rest[0]
    away = np.linalg.norm(rest - np.array(acts.BELLY), axis=1)
    found = np.array([distortion(matrices_of(F)[: len(rest)]) for F in course.F])
    return {
        f"distortion_{100.0 * low:g}_to_{100.0 * high:g}_cm": found[:, (away >= low) & (away < high)].mean(1)
        for low, high in pairwise(SHELLS)
    }


def kick(course: Course) -> Curves:
    """Return the bend of the kicking leg and the speed of the ball."""
    return {
        "leg_error_deg": course.errors_of("right_hip", "right_knee", "right_ankle", "right_foot"),
        "ball_speed_m_s": np.linalg.norm(course.speed[:, 0], axis=1),
    }


def recoil(course: Course) -> Curves:
    """Return the bend of head and neck, and that of trunk and legs."""
    return {
        "head_and_neck_deg": course.errors_of("neck", "head"),
        "trunk_and_legs_deg": course.errors_of(
            "left_hip", "left_knee", "right_hip", "right_knee", "spine1", "spine2", "spine3"
        ),
    }


def objects(course: Course) -> Curves:
    """Return the speed of every object."""
    names = course.stage.simulation.props.names
    return {f"{name}_speed_m_s": np.linalg.norm(course.speed[:, column], axis=1) for column, name in enumerate(names)}


def legs(course: Course) -> Curves:
    """Return the volume that both legs fill, beyond that at the start, and the error of the worst joint."""
    part, names = course.stage.simulation.flesh[0].part, list(BODY_PARTS)
    left, right = (part == names.index(f"{side}_leg") for side in ("left", "right"))
    overlap = 1e6 * np.array([overlap_volume(course, x, left, right) for x in course.x])
    return {"overlap_cm3": overlap - overlap[0], "worst_joint_deg": course.joint_errors.max(1)}


def jiggle(course: Course) -> Curves:
    """Return the motion of the belly's soft flesh relative to its bones, RMS."""
    moved = 1e3 * course.displacements(belly_flesh(course))
    return {"belly_rms_mm": np.sqrt((moved**2).mean(1)), "pelvis_height_m": course.joints[:, 0, 2]}
