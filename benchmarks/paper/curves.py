"""Curves of the paper's figures: values at every moment of an act, shape ``(T,)``, by name."""

from __future__ import annotations

import numpy as np

from benchmarks.paper import acts
from benchmarks.paper.measures import around_hit, belly_flesh, near, overlap_of_legs, strain_by_height
from benchmarks.paper.measures import hem_lift as measured_lift
from benchmarks.paper.stage import Course

#: Curves by name; the only one of an act has none.
Curves = dict[str, np.ndarray]


def impulses(course: Course) -> Curves:
    """Return the impulse of every prop on the avatar in each control step [N s]."""
    names = course.stage.simulation.props.names
    return {name: np.linalg.norm(course.impulse[:, :, 1 + i].sum(1), axis=1) for i, name in enumerate(names)}


def belly_dent(course: Course) -> Curves:
    """Return the mean displacement of the flesh around the belly [mm]."""
    return {"": 1e3 * course.displacements(near(course, acts.BELLY)).mean(1)}


def head_angle(course: Course) -> Curves:
    """Return the sum of the angles by which neck and head are bent [deg]."""
    return {"": course.errors_of("neck", "head")}


def leg_angle(course: Course) -> Curves:
    """Return the sum of the angles by which the kicking leg is bent away from its command [deg]."""
    return {"": course.errors_of("right_hip", "right_knee", "right_ankle", "right_foot")}


def hem_lift(course: Course) -> Curves:
    """Return how much higher the hem of a garment is over the pelvis than at the start [mm]."""
    return {"": 1e3 * measured_lift(course)}


def leg_overlap(course: Course) -> Curves:
    """Return the volume that both legs fill [cm^3]."""
    return {"": 1e6 * overlap_of_legs(course)}


def can_dent(course: Course) -> Curves:
    """Return the largest displacement of the flesh around a can's hit [mm]."""
    return {"": 1e3 * course.displacements(around_hit(course)).max(1)}


def jiggle(course: Course) -> Curves:
    """Return the root mean square displacement of the belly's softest flesh from its bones [mm]."""
    moved = course.displacements(belly_flesh(course))
    return {"": 1e3 * np.sqrt((moved**2).mean(1))}


def slices(course: Course) -> Curves:
    """Return the mean ``|F - R|`` of slices of the body, by height."""
    heights, strain = strain_by_height(course)
    return {f"{height:.4g} m": strain[:, index] for index, height in enumerate(heights)}


def ball_depth(course: Course) -> Curves:
    """Return the distance by which a ball is ahead of where it would touch the belly at rest [mm]."""
    return {"": 1e3 * (course.place[:, 0, 1] + acts.BALL_RADIUS - acts.BELLY[1])}
