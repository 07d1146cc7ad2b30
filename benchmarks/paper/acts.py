"""The scenes of the paper's supplement: what stands where, what flies, what the avatar does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.paper.stage import Act, Pose, Script, View, keyed, played
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.motion import list_motions, load_motion
from piavatar_envs.avatar.motion.keyframes import Arm, Foot, Key, animate
from piavatar_envs.config import AvatarConfig, PropConfig, RegionConfig, SceneConfig
from piavatar_envs.config.schema import GarmentConfig
from piavatar_envs.sim.scene import Domain

BALL_RADIUS = 0.11
CAN_SPEED = 3.0  # [m/s], a fall of 46 cm
JUMP_CLIP = "deepmimic:jump"
FACE = (0.0, -0.13, 1.53)  # a point of the standing body's skin [m]
BELLY = (0.0, -0.13, 1.03)
CHEST = (0.0, -0.14, 1.25)
SHORT = 1.0 / 120.0  # [s], a control step in which a hit is resolved
USUAL_ALPHA = 0.3 * 30.0 * SHORT  # the rate of shape preservation of usual control steps
SOFT = 2e4  # [Pa], of the softest flesh of the trunk

SIDE = View(eye=(3.3, -1.7, 1.1), target=(0.0, -0.35, 0.75), moments=(0.5,))
FRONT = View(eye=(1.6, -3.4, 1.5), target=(0.0, -0.1, 0.85), moments=(0.3,))
HEAD = View(eye=(1.25, -1.7, 1.7), target=(0.0, -0.1, 1.38), moments=(0.2,))


def ball(mass: float, position: tuple, velocity: tuple = (0.0, 0.0, 0.0), young: float | None = None) -> PropConfig:
    """Return a ball of 22 cm."""
    return PropConfig(
        name="ball", size=(BALL_RADIUS,), mass=mass, position=position, velocity=velocity, young_modulus=young
    )


def low_kick() -> Script:
    """Return a kick with the right foot along the ground, once the weight is on the left leg."""
    guard = {
        "left_arm": Arm((0.55, -0.35, -0.75), (0.05, -0.8, 0.35)),
        "right_arm": Arm((0.55, -0.35, -0.75), (0.05, -0.8, 0.35)),
    }
    shift = {"pelvis": (0.16, 0.0, -0.05), "turns": {"spine2": (0.0, -5.0, 0.0)}, **guard}
    back = {"turns": {"pelvis": (8.0, 0.0, -8.0), "spine2": (4.0, -5.0, 10.0)}}
    ahead = {"turns": {"pelvis": (-10.0, 0.0, 8.0), "spine2": (4.0, -5.0, -10.0)}}
    keys = [
        Key(0.0),
        Key(0.3, **shift),
        Key(0.6, pelvis=(0.18, -0.02, -0.06), right_foot=Foot((0.05, 0.42, 0.14), pitch=35.0), **guard, **back),
        Key(0.95, pelvis=(0.18, -0.04, -0.06), right_foot=Foot((0.05, -0.62, 0.06), pitch=-25.0), **guard, **ahead),
        Key(1.25, pelvis=(0.18, -0.04, -0.06), right_foot=Foot((0.05, -0.62, 0.06), pitch=-25.0), **guard, **ahead),
        Key(1.8),
    ]
    return played(animate("low kick", keys, load_asset().joints), start=0.3)


def kicks(masses: tuple[float, ...] = (0.5, 1.5, 8.0)) -> list[Act]:
    """Return acts of the same kick without a ball, and at balls of several masses lying on the ground."""
    act = Act(
        "kick, no ball",
        seconds=1.2,
        script=low_kick(),
        control={"tone": 0.3},
        domain=Domain().including((0.0, -4.0, 0.0)),
        view=replace(SIDE, eye=(3.0, -2.6, 1.0), target=(0.0, -0.6, 0.7), moments=(0.3, 0.5, 0.7)),
        tags={"ball_kg": None},
    )
    found = [act]
    for mass in masses:
        scene = SceneConfig(props=(ball(mass, (-0.14, -0.46, BALL_RADIUS)),))
        found.append(replace(act, name=f"kick, ball of {mass:g} kg", scene=scene, tags={"ball_kg": mass}))
    return found


def belly_balls(masses: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)) -> list[Act]:
    """Return acts of balls of one size, stiffness and speed (3 m/s), light to heavy, against a soft belly."""
    return [
        Act(
            f"ball of {mass:g} kg at the belly",
            seconds=0.2,
            scene=SceneConfig(props=(_at_belly(mass),)),
            physics={"soft_young_modulus": SOFT, "control_dt": SHORT},
            control={"alpha": USUAL_ALPHA},
            view=View((1.5, -0.75, 1.25), (0.0, -0.22, 1.05), (0.05,), ("skin", "strain")),
            tags={"ball_kg": mass},
        )
        for mass in masses
    ]


def _at_belly(mass: float, gap: float = 0.05) -> PropConfig:
    """Return a ball that flies at 3 m/s towards the belly, ``gap`` [m] before it."""
    return ball(mass, (0.0, BELLY[1] - BALL_RADIUS - gap, BELLY[2]), (0.0, 3.0, 0.0), 1e5)


def remedies() -> list[Act]:
    """Return acts of a ball of 2 kg at a soft belly: as usual, and with one remedy of sticky contact taken away."""
    usual, bare = _at_belly(2.0, gap=0.1), []
    for name, scene, physics in (
        ("as usual", {}, {}),
        ("normals of each body", {"contact_normals": "own"}, {}),
        ("contact at 1.5 spacings", {"contact_gate": 1.5}, {}),
        ("no stress", {}, {"decoupling": "no_stress"}),
    ):
        bare.append(
            Act(
                f"ball of 2 kg at the belly, {name}",
                seconds=0.5,
                scene=SceneConfig(props=(usual,), **scene),
                physics={"soft_young_modulus": SOFT, "control_dt": SHORT, **physics},
                control={"alpha": USUAL_ALPHA},
                view=View((1.5, -0.75, 1.25), (0.0, -0.22, 1.02), (0.0583, 0.2667)),
                tags={"variant": name},
            )
        )
    return bare


def blow() -> Act:
    """Return an act of a ball that strikes the belly of a floating, limp body, in steps short beside a wave's way."""
    scene = SceneConfig(
        props=(ball(8.0, (0.0, BELLY[1] - BALL_RADIUS - 0.01, BELLY[2]), (0.0, 8.0, 0.0), 1e5),), ground=False
    )
    return Act(
        "blow to the belly",
        seconds=0.12,
        scene=scene,
        physics={"control_dt": 1.0 / 300.0, "gravity": 0.0},
        control={"tone": 0.0, "alpha": 0.0, "root": "free"},
        view=View((2.6, -2.6, 1.2), (0.0, 0.0, 0.9), (0.01, 0.02, 0.04, 0.08), colors=("distortion",)),
    )


def throws(moduli: tuple[float, ...] = (1e3, 1e4, 1e5, 1e6, 1e7)) -> list[Act]:
    """Return acts of a ball of 1.5 kg thrown at the chest at 4 m/s, from soft to stiff."""
    start = (0.0, CHEST[1] - BALL_RADIUS - 0.25, CHEST[2])
    view = View(eye=(2.0, -1.35, 1.45), target=(0.0, -0.3, 1.15), moments=(0.1, 0.1667))
    return [
        Act(
            f"throw, ball of {young:.0e} Pa",
            seconds=0.6,
            scene=SceneConfig(props=(ball(1.5, start, (0.0, 4.0, 0.0), young),)),
            view=view,
            tags={"young_modulus_pa": young},
        )
        for young in moduli
    ]


def head_hits(tones: tuple[float, ...] = (1.0, 0.3, 0.0)) -> list[Act]:
    """Return acts of a ball of 4 kg thrown at the face at 6 m/s, with the avatar tensed, at ease and limp."""
    thrown = ball(4.0, (0.0, FACE[1] - BALL_RADIUS - 0.2, FACE[2] + 0.02), (0.0, 6.0, 0.0))
    return [
        Act(
            f"head hit, tone {tone:g}",
            seconds=1.5,
            scene=SceneConfig(props=(thrown,)),
            control={"tone": tone},
            view=View(eye=(3.3, -1.9, 1.35), target=(0.0, -0.1, 0.85), moments=(0.1, 0.1667, 0.4)),
            tags={"tone": tone},
        )
        for tone in tones
    ]


def crowd(mesh: Path) -> Act:
    """Return an act of a ball, a box, a capsule and the solid of a mesh file that hit one avatar at once."""
    props = (
        PropConfig(name="ball", size=(0.12,), mass=2.0, position=(0.25, -0.75, 1.15), velocity=(-0.6, 4.0, 1.0)),
        PropConfig(
            name="box", shape="box", size=(0.14, 0.1, 0.1), mass=2.5, position=(-0.35, -0.8, 0.95),
            rotation=(0.92, 0.2, 0.3, 0.1), velocity=(1.2, 4.0, 1.2), spin=(0.0, 0.0, 3.0),
        ),
        PropConfig(
            name="capsule", shape="capsule", size=(0.07, 0.16), mass=1.5, position=(0.0, 0.0, 1.95),
            rotation=(0.7071, 0.0, 0.7071, 0.0), velocity=(0.0, 0.0, -2.0),
        ),
        PropConfig(
            name="torus", shape="mesh", size=(1.0,), file=str(mesh), mass=2.0, position=(0.0, -0.75, 0.55),
            rotation=(0.7071, 0.7071, 0.0, 0.0), velocity=(0.0, 3.5, 1.0),
        ),
    )  # fmt: skip
    return Act(
        "several objects at once",
        seconds=1.0,
        scene=SceneConfig(props=props),
        control={"tone": 0.5},
        view=replace(FRONT, eye=(2.6, -3.0, 1.6), moments=(0.0, 0.2, 0.4)),
    )


def belly_dents() -> list[Act]:
    """Return acts of a heavy ball pushed into a limp avatar's belly, with and without shape preservation."""
    thrown = ball(5.0, (0.0, BELLY[1] - BALL_RADIUS - 0.1, BELLY[2]), (0.0, 3.0, 0.0))
    found = []
    for alpha, kind in ((0.0, "physical"), (0.3, "physical"), (1.0, "physical"), (0.3, "kinematic")):
        found.append(
            Act(
                f"belly dent, alpha {alpha:g}" + (", the paper's term" if kind == "kinematic" else ""),
                seconds=1.3,
                scene=SceneConfig(props=(thrown,)),
                physics={"soft_young_modulus": 2e4},
                control={"tone": 0.0, "alpha": alpha, "shape_preservation": kind},
                view=View((1.7, -1.0, 1.25), (0.0, -0.15, 1.05), (0.0667, 0.2), ("strain",)),
                tags={"alpha": alpha, "shape_preservation": kind},
            )
        )
    return found


def crossed_legs() -> list[Act]:
    """Return acts of legs crossed and opened off the ground, with and without velocity fields for the limbs.

    Once the left leg passes in front of the right one, as far as commanded poses go; once both want the same place.
    """
    found = []
    for pose, left, right in (
        ("one before the other", (-0.20, 0.40, 0.0), (0.10, -0.40, 0.0)),
        ("head on", (-0.12, 0.42, 0.0), (0.05, -0.42, 0.0)),
    ):
        crossed = {"left_hip": left, "right_hip": right}
        for fields in (True, False):
            found.append(
                Act(
                    f"legs crossed {pose}, {'with' if fields else 'without'} limb fields",
                    seconds=2.4,
                    scene=SceneConfig(self_contact=fields, ground=False),
                    script=keyed((0.0, {}), (0.8, crossed), (1.1, crossed), (1.9, {})),
                    view=View(eye=(0.7, -2.0, 0.8), target=(0.0, 0.0, 0.55), moments=(0.5, 1.1, 1.5)),
                    tags={"self_contact": fields, "pose": pose},
                )
            )
    return found


def hair() -> RegionConfig:
    """Return the outer flesh of the head as soft as hair."""
    return RegionConfig(joints=("head",), beyond=0.05, material="fixed_corotated", young_modulus=7e2)


def pillows(moduli: tuple[float, ...] = (1e3, 2e3, 5e3, 1e5)) -> list[Act]:
    """Return acts of a pillow of 0.6 kg thrown at the head at 5 m/s; the last is as stiff as flesh."""
    view = replace(HEAD, eye=(1.9, -1.3, 1.6), moments=(0.0667, 0.1333))
    return [_thrown_pillow(young, "head", FACE, view) for young in moduli]


def pillows_on_body_and_hair(moduli: tuple[float, ...] = (1e3, 1e5)) -> list[Act]:
    """Return acts of the same pillow thrown at the chest, and dropped at that speed on a head of hair."""
    trunk = replace(HEAD, eye=(2.1, -1.5, 1.4), target=(0.0, -0.1, 1.15), moments=(0.0667, 0.1333))
    above = replace(HEAD, eye=(1.7, -1.3, 1.85), target=(0.0, -0.05, 1.55), moments=(0.0667, 0.1333))
    top = (0.0, -0.02, float(load_asset().mean_body().vertices[:, 2].max()))
    thrown = [_thrown_pillow(young, "chest", CHEST, trunk) for young in moduli]
    return thrown + [_thrown_pillow(young, "hair", top, above, regions=(hair(),), down=True) for young in moduli]


def _thrown_pillow(
    young: float, site: str, place: tuple, view: View, regions: tuple[RegionConfig, ...] = (), down: bool = False
) -> Act:
    """Return an act of a pillow that meets a place of the skin with its broad side, from the front or from above."""
    gap = 0.3
    start = (place[0], place[1], place[2] + gap) if down else (place[0], place[1] - gap, place[2])
    pillow = PropConfig(
        name="pillow", shape="box", size=(0.20, 0.14, 0.07) if down else (0.20, 0.07, 0.14), mass=0.6,
        young_modulus=young, poisson_ratio=0.1, position=start, velocity=(0.0, 0.0, -5.0) if down else (0.0, 5.0, 0.0),
    )  # fmt: skip
    return Act(
        f"pillow of {young:.0e} Pa at the {site}",
        seconds=0.7,
        scene=SceneConfig(avatars=(AvatarConfig(regions=regions),), props=(pillow,)),
        control={"tone": 0.3},
        view=view,
        tags={"site": site, "young_modulus_pa": young},
    )


def cans(mesh: Path) -> list[Act]:
    """Return acts of a can of 0.35 kg against head, belly and ankle, on flesh and on a region of another material."""
    top, down = load_asset().mean_body().vertices[:, 2].max(), (0.0, 0.0, -CAN_SPEED)
    garment = RegionConfig(
        joints=("pelvis", "spine1", "spine2", "spine3"), beyond=0.05, material="fixed_corotated", young_modulus=1e3
    )
    boot = RegionConfig(joints=("left_ankle", "left_foot"), young_modulus=5e5)
    lying = (0.7071, 0.0, 0.7071, 0.0)
    both = ("skin", "strain")
    above = View((0.6, -0.85, 1.85), (0.0, 0.0, 1.66), (0.0667,), both)
    low = View((0.85, -0.75, 0.45), (0.15, -0.1, 0.14), (0.1,), both)
    sites = (
        ("head", hair(), "hair", (0.0, -0.02, float(top) + 0.12), lying, down, above),
        ("belly", garment, "garment", (0.0, BELLY[1] - 0.12, BELLY[2]), lying, (0.0, CAN_SPEED, 0.0),
         View((0.95, -0.8, 1.3), (0.0, -0.12, 1.06), (0.0667,), both)),
        ("ankle", boot, "stiff", (0.18, -0.28, 0.16), lying, (0.0, CAN_SPEED, 0.0), low),
    )  # fmt: skip
    found = []
    for site, region, name, place, turn, velocity, view in sites:
        can = PropConfig(
            name="can", shape="mesh", size=(1.0,), file=str(mesh), mass=0.35, position=place, rotation=turn,
            velocity=velocity,
        )  # fmt: skip
        for regions in ((), (region,)):
            material = name if regions else "flesh"
            found.append(
                Act(
                    f"can on the {site}, {material}",
                    seconds=0.6,
                    scene=SceneConfig(avatars=(AvatarConfig(regions=regions),), props=(can,)),
                    view=view,
                    tags={"site": site, "material": material, "young_modulus_pa": _modulus(regions)},
                )
            )
    return found


#: Speed of the spin [rev/s], the times at which it begins, is reached, ends, and stands still [s].
SPIN_SPEED, SPIN_TIMES = 1.5, (0.2, 0.9, 2.0, 2.2)
#: Times at which the body of the jump crouches, takes off, is highest, lands, crouches and stands [s].
JUMP_TIMES = (0.35, 0.55, 0.8, 1.05, 1.25, 1.6)


def spun(times: tuple[float, ...] = SPIN_TIMES, speed: float = SPIN_SPEED) -> Script:
    """Return a spin on the spot with the arms held out, evenly faster and slower between the times [s], [rev/s]."""
    arms = {"left_shoulder": (0.0, -0.6, 0.0), "right_shoulder": (0.0, 0.6, 0.0)}
    out, turn = keyed((0.0, {}), (times[0], arms), (times[-1] + 9.0, arms)), 2.0 * np.pi * speed
    begin, full, end, still = times

    def angle(time: float) -> float:
        rise, fall = np.clip(time - begin, 0.0, full - begin), np.clip(time - end, 0.0, still - end)
        even = np.clip(time - full, 0.0, end - full)
        return turn * (0.5 * rise**2 / (full - begin) + even + fall - 0.5 * fall**2 / (still - end))

    def script(time: float) -> Pose:
        rotation, root = out(time)
        rotation[0] = (0.0, 0.0, angle(time))
        return rotation, root

    return script


def leapt() -> Script:
    """Return a jump on the spot: a crouch, 0.35 m up and down again, and a landing in a crouch."""
    crouch = {"root": (0.0, 0.02, -0.2)}
    for side in ("left", "right"):
        crouch |= {
            f"{side}_hip": (-0.9, 0.0, 0.0),
            f"{side}_knee": (1.55, 0.0, 0.0),
            f"{side}_ankle": (-0.65, 0.0, 0.0),
        }
    down, off, top, land, low, up = JUMP_TIMES
    tips = {"left_ankle": (0.5, 0.0, 0.0), "right_ankle": (0.5, 0.0, 0.0)}
    arms = {"left_shoulder": (0.0, -0.7, 0.0), "right_shoulder": (0.0, 0.7, 0.0)}
    return keyed(
        (0.0, {}), (down, crouch), (off, {"root": (0.0, 0.0, 0.08), **tips, **arms}),
        (top, {"root": (0.0, 0.0, 0.35), **tips, **arms}), (land, {"root": (0.0, 0.0, 0.02), **arms}), (low, crouch),
        (up, {}),
    )  # fmt: skip


def dresses() -> list[Act]:
    """Return acts of a body in a dress that spins and stops, and that jumps."""
    dress = GarmentConfig(kind="dress", fabric="cotton")
    spin = View(eye=(1.1, -4.1, 1.3), target=(0.0, 0.0, 0.84), moments=(0.2, 0.6, 1.2, 1.9, 2.2, 2.5, 3.0))
    leap = replace(
        spin, eye=(1.3, -4.9, 1.3), target=(0.0, 0.0, 1.02), moments=(0.3, 0.5667, 0.8, 1.0, 1.1333, 1.3, 1.9)
    )
    return [
        Act("spin in a dress", 3.2, garments=(dress,), script=spun(), view=spin, tags={"rev_s": SPIN_SPEED}),
        Act("jump in a dress", 2.4, garments=(dress,), script=leapt(), view=leap, tags={"rev_s": None}),
    ]


def _modulus(regions: tuple[RegionConfig, ...]) -> float | None:
    return regions[0].young_modulus if regions else 1e5


def drops() -> list[Act]:
    """Return acts of a body that is set down from 0.3 m within 0.25 s: firm flesh, and soft flesh that lags."""
    down, up = {"root": (0.0, 0.0, 0.0)}, {"root": (0.0, 0.0, 0.3)}
    view = View((2.2, -1.2, 1.25), (0.0, -0.1, 1.12), (0.8667, 1.0), ("strain",))
    script = keyed((0.0, down), (0.6, up), (0.75, up), (1.0, down))
    return _landings("drop", script, 1.8, "scripted drop of 0.3 m", view)


def jumps() -> list[Act]:
    """Return the same acts in the jump of a motion clip; none where the clip is not installed."""
    if JUMP_CLIP not in list_motions():
        return []
    motion = load_motion(JUMP_CLIP)
    script = played(motion.translated([*-motion.root_position[0, :2], 0.0]))
    view = View((4.6, -1.9, 1.1), (0.0, -0.55, 0.92), (0.0, 0.9667, 1.3333), ("strain",))
    return _landings("jump", script, 1.75, JUMP_CLIP, view)


def _landings(title: str, script: Script, seconds: float, clip: str, view: View) -> list[Act]:
    found = []
    for name, soft, young in (
        ("firm flesh", 0.0, None),
        ("soft flesh", 0.8, 2e4),
        ("softer flesh", 0.8, 5e3),
    ):
        found.append(
            Act(
                f"{title}, {name}",
                seconds=seconds,
                scene=SceneConfig(avatars=(AvatarConfig(shape={"parameters": {"belly": 1.0, "weight": 0.7}}),)),
                script=script,
                physics={"soft_young_modulus": young},
                control={"soft_tissue": soft},
                domain=Domain().including((0.0, -2.8, 0.0)),
                view=view,
                tags={"clip": clip, "soft_tissue": soft, "soft_young_modulus_pa": young},
            )
        )
    return found
