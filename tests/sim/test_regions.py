"""Regions of other flesh on a character of a file: soft, light hair and a skirt, held by rates of their own.

The file is written from the embedded body, with a thick cap of hair, a thick skirt and a painted chest.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from piavatar_envs import inspection
from piavatar_envs.avatar.body.groups import read_groups
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, joint_index, skin
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.config import ConfigError
from piavatar_envs.mpm.diagnostics import totals
from piavatar_envs.mpm.materials import material_index
from scripts.gltf_files import rig_of
from scripts.synthetic_character import dressed

STAND = "PIAvatar/Stand-v0"
EMPTY = {"gravity": 0.0, "scene": {"ground": False, "walls": False}}
CONFIG = Path(__file__).resolve().parents[2] / "configs" / "heterogeneous.yaml"
HAIR, CLOTH = yaml.safe_load(CONFIG.read_text(encoding="utf-8"))["scene"]["avatars"][0]["regions"]
ANKLE = {"joints": ["left_ankle", "left_foot"], "young_modulus": 5.0e5}
#: Where a can begins and which way it flies, by what it strikes.
THROWS = {
    "hair": ((0.0, 0.03, 1.83), (0.0, 0.0, -2.5)),
    "cloth": ((0.0, -0.30, 0.85), (0.0, 2.5, 0.0)),
    "ankle": ((0.10, -0.26, 0.10), (0.0, 2.5, 0.0)),
}


@pytest.fixture(scope="module")
def hero(tmp_path_factory):
    """Return the settings of the source."""
    asset = load_asset()
    chest = asset.skin_joints[:, 0] == joint_index("spine3")
    attributes = {"_VEST": (chest[:, None].astype("<f4"), "SCALAR")}
    rig = rig_of(asset, JOINT_NAMES, parts=dressed(asset), material={"name": "skin"}, attributes=attributes)
    return {"source": "glb", "path": str(rig.write().save(tmp_path_factory.mktemp("hero") / "hero.glb"))}


def scene_of(regions, **more) -> dict:
    return {"avatars": [{"regions": regions}], **more}


def shape_error(simulation) -> np.ndarray:
    """Return displacements of the first avatar's particles from their skinned places on the tracked bones [m]."""
    flesh, tracked = simulation.flesh[0], simulation.avatars[0].tracked
    sampled, points = flesh.sampled, flesh.points
    rotations = Rotation.from_quat(tracked.rotation.numpy()[0]).as_matrix()
    place = skin(
        points.rest[0], sampled.skin_joints, sampled.skin_weights, rotations, tracked.position.numpy()[0],
        points.joints[0],
    )  # fmt: skip
    return simulation.state.x.numpy()[0, : len(sampled)] - place


# ---- from the file to the particles


def test_meshes_materials_and_painted_groups_are_groups(hero):
    asset = load_asset(**hero)
    assert set(asset.groups) == {"Body", "skin", "Hair", "hair", "Skirt", "cloth", "vest"}
    assert all(w.shape == (len(asset.vertices),) and 0.0 <= w.min() <= w.max() <= 1.0 for w in asset.groups.values())
    head, waist = asset.joints[joint_index("head"), 2], asset.joints[joint_index("spine2"), 2]
    hair, cloth, vest = (asset.groups[name] > 0.5 for name in ("hair", "cloth", "vest"))
    assert asset.vertices[hair, 2].min() > head and asset.vertices[:, 2].argmax() in np.flatnonzero(hair)
    assert asset.vertices[cloth, 2].max() < waist
    assert np.mean(asset.skin_joints[vest, 0] == joint_index("spine3")) > 0.95
    covered = sum((asset.groups[name] for name in ("skin", "hair", "cloth")), np.zeros(len(asset.vertices)))
    assert covered == pytest.approx(1.0, abs=0.05)


def test_attributes_that_are_no_groups_do_no_harm(tmp_path):
    asset = load_asset()
    count = len(asset.vertices)
    attributes = {
        "_ID": (np.arange(count, dtype="<f4")[:, None], "SCALAR"),
        "_FLOW": (np.zeros((count, 3), "<f4"), "VEC3"),
        "_HOLE": (np.full((count, 1), np.nan, "<f4"), "SCALAR"),
        "_PART": (np.ones((3, 1), "<f4"), "SCALAR"),
    }
    path = rig_of(asset, JOINT_NAMES, attributes=attributes).write().save(tmp_path / "odd.glb")
    assert set(load_asset("glb", path=str(path)).groups) == {"Body"}


def test_inspect_lists_the_groups(hero, tmp_path):
    report = json.loads(json.dumps(inspection.examine(Path(hero["path"]))))
    shares = dict(line.split(": ") for line in report["groups"])
    assert float(shares["hair"].split("%")[0]) == pytest.approx(6.0, abs=2.0)
    assert set(shares) == {"Body", "skin", "Hair", "hair", "Skirt", "cloth", "vest"}


def test_groups_are_of_another_material_in_every_environment(make_env, make_batch, hero):
    regions = [HAIR, CLOTH, ANKLE, {"group": "vest", "joints": ["spine3"], "density": 1500.0}]
    env = make_env(STAND, avatar=hero, scene=scene_of(regions))
    simulation = env.batch.simulation
    particles, sampled = simulation.model.particles, simulation.flesh[0].sampled
    young, density = particles.mu.numpy()[0] * 2.6, particles.mass.numpy()[0] / particles.volume.numpy()[0]
    hair, cloth, ankle, vest = (simulation.flesh[0].in_region(r) for r in simulation.flesh[0].avatar.regions)
    assert min(hair.sum(), cloth.sum(), ankle.sum(), vest.sum()) >= 5
    assert (sampled.depth[hair | cloth] <= 0.05).all()
    assert young[hair] == pytest.approx(500.0, rel=1e-5) and density[hair] == pytest.approx(300.0, rel=1e-4)
    assert young[cloth] == pytest.approx(1000.0, rel=1e-5) and density[vest] == pytest.approx(1500.0, rel=1e-4)
    corotated = particles.material.numpy()[0] == material_index("fixed_corotated")
    assert (corotated == (hair | cloth)).all()
    batch = make_batch("PIAvatar/KickBall-v0", 3, avatar=hero, scene=scene_of(regions))
    count = len(sampled)
    assert (batch.simulation.model.particles.mu.numpy()[:, :count] == particles.mu.numpy()[0, :count]).all()


def test_the_papers_avatar_is_a_file_of_settings(make_env, hero):
    simulation = make_env("PIAvatar/Reach-v0", config=CONFIG, avatar=hero).batch.simulation
    assert [region.group for region in simulation.flesh[0].avatar.regions] == ["hair", "cloth"]
    young = simulation.model.particles.mu.numpy()[0] * 2.6
    assert np.unique(young) == pytest.approx([500.0, 1000.0, 1.0e5], rel=1e-5)


def test_segmentations_are_groups(tmp_path):
    file = tmp_path / "groups.json"
    file.write_text('{"head": [0, 2], "hand": []}')
    groups = read_groups(file, 3)
    assert groups["head"].tolist() == [1.0, 0.0, 1.0] and not groups["hand"].any()
    for content in ("[1]", '{"head": [3]}', '{"head": [true]}', '{"head": "all"}', '{"head": [0.5]}', "{"):
        file.write_text(content)
        with pytest.raises(ValueError, match="is not groups of vertices"):
            read_groups(file, 3)


@pytest.mark.parametrize(
    ("region", "said"),
    [
        ({"group": "cape", "density": 500.0}, "no group 'cape' on its skin; it has Body, skin, Hair, hair"),
        ({"group": "hair", "depth": 1e-4}, "group 'hair' and within depth=0.0001 m.*particles are .* mm apart"),
        ({"group": "hair", "joints": ["pelvis"]}, r"group 'hair' and \['pelvis'\]"),
        ({"density": 500.0}, "neither joints nor a group are given"),
        ({"group": "hair", "alpha": 0.5}, "no effect under control.mode='pd'; give flesh_rate"),
    ],
)
def test_regions_that_cannot_be_are_refused(make_env, hero, region, said):
    with pytest.raises(ConfigError, match=said):
        make_env(STAND, avatar=hero, scene=scene_of([region]))


def test_a_body_without_groups_says_so(make_env):
    with pytest.raises(ConfigError, match=r"embedded.*has none"):
        make_env(STAND, scene=scene_of([{"group": "hair"}]))


# ---- what holds them


def test_regions_are_held_by_rates_of_their_own(make_env, hero):
    regions = [HAIR | {"alpha": 0.9, "flesh_rate": [50.0, 60.0]}, CLOTH]
    env = make_env(STAND, avatar=hero, scene=scene_of(regions), control="pose", alpha=0.2)
    simulation = env.batch.simulation
    hair = simulation.flesh[0].in_region(simulation.flesh[0].avatar.regions[0])
    rates = simulation.flesh[0].shape_rates(simulation.model)
    assert rates[:, 0] == pytest.approx(np.where(hair, 27.0, 6.0)) and (rates[:, 1] == 0.0).all()
    own = make_env(STAND, avatar=hero, scene=scene_of(regions), control="pd")
    usual = make_env(STAND, avatar=hero, scene=scene_of([HAIR, CLOTH]), control="pd")
    given, before = (env.batch.simulation._torque[0].flesh_rate for env in (own, usual))
    assert (given[~hair] == before[~hair]).all()
    assert 50.0 <= given[hair].min() <= given[hair].max() <= 60.0


@pytest.mark.parametrize(("mode", "most"), [("pose", 0.003), ("pd", 0.03)])
def test_soft_hair_and_cloth_keep_their_shape_under_random_actions(make_env, hero, mode, most):
    settings = {"control": mode} | ({"root_assist": 1.0} if mode == "pd" else {})
    env = make_env(STAND, avatar=hero, scene=scene_of([HAIR, CLOTH]), **settings)
    plain = make_env(STAND, avatar=hero, **settings)
    assert env.batch.simulation.model.num_substeps == plain.batch.simulation.model.num_substeps
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(100):
        *_, ended, _, _ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
        assert not ended and env.batch.simulation.state.failure.numpy()[0] == 0
    simulation = env.batch.simulation
    error = np.linalg.norm(shape_error(simulation), axis=1)
    for region in simulation.flesh[0].avatar.regions:
        assert error[simulation.flesh[0].in_region(region)].mean() < most


# ---- a can against them


@pytest.fixture(scope="module")
def thrown(make_env, hero):
    """Return a function: deepest dent [m], least speed along the throw [m/s] and lost share of momentum of a throw."""
    found: dict[tuple, tuple[float, float, float]] = {}

    def throw(site: str, region: dict) -> tuple[float, float, float]:
        if (site, repr(region)) in found:
            return found[site, repr(region)]
        place, velocity = (np.array(value) for value in THROWS[site])
        can = {
            "name": "can", "shape": "capsule", "size": [0.08, 0.05], "mass": 0.35, "young_modulus": 1.0e5,
            "position": place.tolist(), "velocity": velocity.tolist(), "rotation": [0.7071, 0.0, 0.7071, 0.0],
        }  # fmt: skip
        scene = scene_of([region], props=[can], **EMPTY["scene"])
        free = {"control": "pose", "root": "free", "alpha": 0.0, "tone": 0.0, "gravity": 0.0, "pose_noise": 0.0}
        env = make_env(STAND, avatar=hero, scene=scene, control_dt=1.0 / 300.0, **free)
        env.reset(seed=0)
        simulation, way = env.batch.simulation, velocity / np.linalg.norm(velocity)
        inside = simulation.flesh[0].in_region(simulation.flesh[0].avatar.regions[0])
        before, dent, least = totals(simulation.model, simulation.state).momentum, 0.0, np.inf
        for _ in range(40):
            env.step(np.zeros(env.action_space.shape, np.float32))
            dent = max(dent, float((shape_error(simulation)[inside] @ way).max()))
            least = min(least, float(simulation.props.state.velocity.numpy()[0, 0] @ way))
        lost = totals(simulation.model, simulation.state).momentum - before
        found[site, repr(region)] = dent, least, float(np.linalg.norm(lost) / np.linalg.norm(before))
        return found[site, repr(region)]

    return throw


@pytest.mark.parametrize(("site", "region"), [("hair", HAIR), ("cloth", CLOTH)])
def test_softer_regions_are_dented_more_and_throw_back_less(thrown, site, region):
    # A blow of m v^2 / 2 on an elastic layer dents it by about E^(-1/2), until what lies beneath takes part.
    hard, medium, soft = (thrown(site, region | {"young_modulus": young}) for young in (1.0e5, 2.5e4, 1.0e3))
    assert 1.4 < medium[0] / hard[0] < 2.8  # about 2
    assert soft[0] > 1.1 * medium[0]
    assert soft[1] > hard[1] + 0.05  # velocity along the throw, negative after a rebound


def test_a_stiff_ankle_is_dented_less(thrown):
    usual, stiff = (thrown("ankle", ANKLE | {"young_modulus": young}) for young in (1.0e5, 5.0e5))
    assert stiff[0] < 0.8 * usual[0]


@pytest.mark.parametrize(("site", "region"), [("hair", HAIR), ("cloth", CLOTH), ("ankle", ANKLE)])
def test_blows_on_regions_keep_momentum(thrown, site, region, device):
    # The integers of a GPU's shared memory round to a quantum of the whole body, which has 170 times the can's mass.
    assert thrown(site, region)[2] < (1e-5 if device == "cpu" else 3e-4)
