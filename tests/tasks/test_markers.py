"""Markers of tasks: shown where they were declared and written, and those of the host beside them."""

from __future__ import annotations

import numpy as np
import pytest

from piavatar_envs.api.pictures import SceneReader
from piavatar_envs.config import ConfigError, load_config
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.render import Arrow, Sphere
from piavatar_envs.sim.markers import MarkerSpec
from piavatar_envs.tasks import load_task
from piavatar_envs.tasks.reach import ReachTask
from tests.tasks.measured import markers_of


class Marked(ReachTask):
    """Reach with marks that the host describes."""

    def markers(self, env, index: int) -> list:
        """Return a sphere, as a tuple, and an arrow."""
        return [((0.1, 0.2, 0.3), 0.05, (1.0, 0.0, 0.0)), Arrow((0.0, 0.0, 1.0), (0.0, 0.0, 0.5))]


def test_marks_of_the_host_are_shown_beside_declared_ones_and_refused_for_pixels(device):
    batch = BatchEnv(Marked(load_config(Marked.Config, None, {"fidelity": "tiny"})), 1, device)
    batch.reset()
    target, sphere, arrow = SceneReader(batch).scene(0).markers
    goal = markers_of(batch).position.numpy()[0, 0]
    np.testing.assert_allclose(target.mesh()[0], Sphere(goal, batch.config.target_radius).mesh()[0], atol=1e-6)
    assert (target.kind, sphere.kind, arrow.kind) == ("sphere", "sphere", "arrow")
    np.testing.assert_array_equal(sphere.position, (0.1, 0.2, 0.3))
    with pytest.raises(ConfigError, match=r"Marked\.markers .* Marked\.marker_specs"):
        batch.task.check_pixels()


def test_tasks_of_the_package_describe_their_markers_once(env_id):
    task = load_task(env_id)
    task(task.Config()).check_pixels()


def test_hidden_markers_are_left_out_of_scenes(device):
    class Hidden(ReachTask):
        def marker_specs(self):
            return (*super().marker_specs(), MarkerSpec("box", (0.1, 0.1, 0.1), visible=False))

    batch = BatchEnv(Hidden(load_config(Hidden.Config, None, {"fidelity": "tiny"})), 1, device)
    batch.reset()
    assert [marker.kind for marker in SceneReader(batch).scene(0).markers] == ["sphere"]


def test_the_target_of_push_box_lies_on_the_ground(make_batch):
    batch = make_batch("PIAvatar/PushBox-v0", 3)
    batch.reset(seeds=[1, 2, 3])
    (spec,) = batch.task.marker_specs()
    assert spec.kind == "ring" and spec.size[0] == batch.config.target_radius
    position = markers_of(batch).position.numpy()[:, 0]
    np.testing.assert_allclose(position, batch.task.target.numpy() + [0.0, 0.0, 0.01], atol=1e-6)
    assert len(np.unique(position[:, 0])) == 3
