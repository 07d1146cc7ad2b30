"""A can against hair, skirt and ankle of a character, as flesh and as regions of other flesh.

``python -m scripts.synthetic_character hero.glb --thick`` writes a character with the materials ``hair`` and
``cloth``, and ``python -m benchmarks.physics.regions hero.glb --picture regions.jpg`` throws the can. Hair and cloth
are those of ``configs/heterogeneous.yaml``, the paper's heterogeneous avatar. A row per throw has the deepest dent of
the place that was struck and the can's velocity along the throw 0.15 s after its start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
import yaml

from benchmarks import runner
from benchmarks.paper import measures
from benchmarks.paper.stage import Act, Pose, View, perform
from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.config import AvatarConfig, PropConfig, RegionConfig, SceneConfig
from piavatar_envs.render import label

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "heterogeneous.yaml"
SPEED = 2.5  # of the can [m/s]
MASS, RADIUS, HALF_LENGTH = 0.35, 0.04, 0.045  # of the can [kg], [m]
GAP = 0.06  # between the can's surface and the skin at first [m]


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the throws."""

    #: GLB file of a character with materials ``hair`` and ``cloth`` that are body
    avatar: Annotated[Path, tyro.conf.Positional] = Path("hero.glb")
    #: resolution of the bodies
    fidelity: Literal["tiny", "coarse", "medium", "fine"] = "medium"
    #: picture to write of the throws at hair and skirt, each at its deepest dent
    picture: Path | None = None
    #: width and height of each of its parts [px]
    size: int = 420


def cases(options: Options) -> Iterator[dict[str, Any]]:
    """Yield a row for each throw, and write the picture."""
    shown = []
    acts = throws(options.avatar)
    for act in runner.progress(acts, "regions"):
        size = options.size if options.picture and act.tags["site"] != "ankle" else 0
        course = perform(act, options.fidelity, options.device, size=size)
        way = course.speed[0, 0] / np.linalg.norm(course.speed[0, 0])
        measured = measures.can(course) | {"left_m_s": float(course.speed[-1, 0] @ way), "failed": course.failed}
        yield {"case": act.name} | act.tags | measured
        if size:
            dent = 1e3 * course.displacements(measures.around_hit(course)).max(1)
            steps = np.round(np.array(act.view.moments) / course.stage.dt).astype(int)
            deepest = int(dent[steps].argmax())
            shown.append(label(course.frames[deepest], f"{act.name}: {measured['peak_dent_mm']:.0f} mm"))
    if options.picture:
        from PIL import Image

        rows = [np.concatenate(shown[first : first + 2], axis=1) for first in range(0, len(shown), 2)]
        Image.fromarray(np.concatenate(rows)).save(options.picture, quality=85)


def throws(path: Path) -> list[Act]:
    """Return acts of a can that strikes hair, skirt and ankle, each of the body's flesh and of a region."""
    source = {"source": "glb", "path": str(path)}
    body = load_asset(**source).mean_body()
    vertices, joints = body.vertices.astype(float), body.joints.astype(float)
    hair, cloth = (RegionConfig(**region) for region in _regions())
    boot = RegionConfig(joints=("left_ankle", "left_foot"), young_modulus=5.0e5)
    top = vertices[vertices[:, 2].argmax()]
    skirt = 0.475 * top[2]
    front = vertices[(abs(vertices[:, 2] - skirt) < 0.02) & (abs(vertices[:, 0]) < 0.05), 1].min()
    ankle = joints[joint_index("left_ankle")] + [0.0, 0.0, 0.02]
    shin = vertices[np.linalg.norm(vertices[:, [0, 2]] - ankle[[0, 2]], axis=1) < 0.03, 1].min()
    sites = (
        ("hair", hair, (top[0], top[1], top[2] + GAP + RADIUS), (0.0, 0.0, -SPEED), (0.75, -1.1, 2.05)),
        ("skirt", cloth, (0.0, front - GAP - RADIUS, skirt), (0.0, SPEED, 0.0), (0.9, -1.2, 1.25)),
        ("ankle", boot, (ankle[0], shin - GAP - RADIUS, ankle[2]), (0.0, SPEED, 0.0), (0.9, -1.2, 0.4)),
    )

    def rest(_time: float) -> Pose:
        return np.zeros((NUM_JOINTS, 3)), joints[0]

    found = []
    for site, region, place, velocity, eye in sites:
        can = PropConfig(
            name="can", shape="capsule", size=(RADIUS, HALF_LENGTH), mass=MASS, young_modulus=1.0e5,
            position=tuple(map(float, place)), rotation=(0.7071, 0.0, 0.7071, 0.0), velocity=velocity,
        )  # fmt: skip
        target = (0.0, float(place[1]) * 0.3, float(place[2]) - (0.12 if site == "hair" else 0.0))
        moments = tuple(step / 60.0 for step in range(1, 9))
        for kind, regions in (("flesh", ()), ("region", (region,))):
            young = regions[0].young_modulus if regions else 1.0e5
            found.append(
                Act(
                    f"{site}, {kind} of {young:g} Pa",
                    seconds=0.15,
                    scene=SceneConfig(avatars=(AvatarConfig(avatar=source, regions=regions),), props=(can,)),
                    script=rest,
                    physics={"control_dt": 1.0 / 120.0},
                    view=View(eye, target, moments),
                    tags={"site": site, "material": kind, "young_modulus_pa": young},
                )
            )
    return found


def _regions() -> list[dict[str, Any]]:
    """Return the settings of hair and cloth."""
    return yaml.safe_load(CONFIG.read_text(encoding="utf-8"))["scene"]["avatars"][0]["regions"]


if __name__ == "__main__":
    runner.main("regions", cases, Options)
