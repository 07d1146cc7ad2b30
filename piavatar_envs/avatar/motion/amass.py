"""AMASS motion capture (Mahmood et al., "AMASS: Archive of motion capture as surface shapes", 2019).

Both layouts are read: SMPL-H (``poses`` (N, 156), ``mocap_framerate``) and SMPL-X (``poses`` (N, 165),
``mocap_frame_rate``); in both the first 66 numbers of a frame are the axis-angle vectors of the root and 21 body joints
in our order. The world is z-up. The canonical SMPL body is y-up and faces +z in a T-pose; its root rotation stands it
up. Files are the user's; nothing is unpickled.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, joint_index
from piavatar_envs.avatar.motion.motion import GREATEST_TURN, Motion
from piavatar_envs.avatar.motion.retarget import LIMB_ENDS, align_limbs, leg_length, retarget, root_path
from piavatar_envs.core.reading import numbers, reading

#: Width of ``poses`` -> the key that names the frame rate.
LAYOUTS: dict[int, str] = {156: "mocap_framerate", 165: "mocap_frame_rate"}
MAX_BYTES = 2**31  # of all arrays of a file, unpacked: hours of capture
LEG_LENGTH = 0.78  # [m] hip to knee to ankle of a person of SMPL's mean shape, about 1.7 m tall
HIP_DROP = 0.09  # [m] how far below SMPL's pelvis joint the hips of that person are
#: Our body axes (z-up, facing -y) to SMPL's (y-up, facing +z); left is +x in both.
_FROM_REST = Rotation.from_euler("x", -90.0, degrees=True)
_LEFT, _DOWN = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
_T_POSE = {
    "left_shoulder": _LEFT,
    "left_elbow": _LEFT,
    "right_shoulder": -_LEFT,
    "right_elbow": -_LEFT,
    **{f"{side}_{joint}": _DOWN for side in ("left", "right") for joint in ("hip", "knee")},
    "left_ankle": None,
    "right_ankle": None,
}


def load_file(path: str | Path, rest_joints: np.ndarray, zero_joints: np.ndarray | None = None) -> Motion:
    """Load an AMASS ``.npz`` and retarget it; the ground offset is the caller's.

    ``trans`` is taken as the pelvis up to a constant (the canonical pelvis, which needs the body model): a constant
    shift on the ground means nothing, and the height is set by the ground offset.

    Args:
        path: the file.
        rest_joints: joints of the body it shall move [m], shape ``(22, 3)``.
        zero_joints: joints of the recorded subject in SMPL's zero pose and axes [m], shape ``(22, 3)``, from a body
            model the user owns. Without them an ideal T-pose with straight legs is assumed (a few degrees off at the
            legs) and legs of 0.78 m.

    Raises:
        ValueError: a pickle, a broken or foreign file, missing keys, wrong shapes or values that are not finite.
        FileNotFoundError: there is no such file.
    """
    path = Path(path)
    poses, trans, fps = _read(path)
    local = [Rotation.from_rotvec(poses[:, 3 * joint : 3 * joint + 3]) for joint in range(NUM_JOINTS)]
    world: list[Rotation] = [local[0]]
    for joint in range(1, NUM_JOINTS):
        world.append(world[PARENTS[joint]] * local[joint])
    if zero_joints is not None:
        zero_joints = np.asarray(zero_joints, dtype=np.float64)
    directions = _T_POSE if zero_joints is None else _directions(zero_joints)
    source_leg = LEG_LENGTH if zero_joints is None else leg_length(zero_joints)
    hips = np.array([0.0, -HIP_DROP, 0.0])
    if zero_joints is not None:
        hips = 0.5 * (zero_joints[joint_index("left_hip")] + zero_joints[joint_index("right_hip")]) - zero_joints[0]
    rotations = retarget(world, align_limbs(rest_joints, directions), Rotation.identity(), _FROM_REST)
    hip_centre = (trans + world[0].apply(hips)) * leg_length(rest_joints) / source_leg
    return Motion(
        name=path.stem,
        fps=fps,
        local_rotations=rotations,
        root_position=root_path(hip_centre, Rotation.from_quat(rotations[:, 0], scalar_first=True), rest_joints),
        source=f"AMASS {path}",
    )


def _directions(zero_joints: np.ndarray) -> dict[str, np.ndarray | None]:
    """Return the limb directions of a subject's zero pose, in our axes."""
    if zero_joints.shape != (NUM_JOINTS, 3):
        raise ValueError(f"zero_joints has shape {zero_joints.shape}, expected ({NUM_JOINTS}, 3)")
    ours = _FROM_REST.inv().apply(zero_joints)
    limbs = {name: ours[joint_index(end)] - ours[joint_index(name)] for name, end in LIMB_ENDS.items()}
    return {**limbs, "left_ankle": None, "right_ankle": None}


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return ``poses`` (N, 66) axis-angle [rad], ``trans`` (N, 3) [m] and the rate [1/s]; only these keys are read."""
    if path.suffix.lower() != ".npz":
        raise ValueError(f"{path}: AMASS motions are .npz files, nothing else is read (a pickle would run code)")
    if not path.is_file():
        raise FileNotFoundError(f"no motion file {path}")
    with reading(path, "an AMASS motion"):
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                size = sum(entry.file_size for entry in archive.infolist())
            if size > MAX_BYTES:
                raise ValueError(f"its arrays have {size} bytes, the limit is {MAX_BYTES}; cut it into clips")
        content = np.load(path, allow_pickle=False)
        if not isinstance(content, np.lib.npyio.NpzFile):
            raise ValueError("it is a single array, and not an archive of several")
        with content:
            keys = set(content.files)
            missing = {"poses", "trans"} - keys
            if missing:
                raise ValueError(f"keys {sorted(missing)} are missing, it has {sorted(keys)}")
            poses, trans = numbers(content, "poses"), numbers(content, "trans")
            rate_key = LAYOUTS.get(poses.shape[-1] if poses.ndim == 2 else 0)
            if rate_key is None:
                raise ValueError(f"poses has shape {poses.shape}, expected (N, 156) for SMPL-H or (N, 165) for SMPL-X")
            # Some releases name the rate as the other layout does.
            rate_key = rate_key if rate_key in keys else next((k for k in LAYOUTS.values() if k in keys), None)
            if rate_key is None:
                raise ValueError(f"the rate is missing: neither of {sorted(LAYOUTS.values())} is in {sorted(keys)}")
            rate = numbers(content, rate_key)
    return _checked(path, poses, trans, rate)


def _checked(
    path: Path, poses: np.ndarray, trans: np.ndarray, rate: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    if trans.shape != (len(poses), 3) or len(poses) < 2:
        raise ValueError(
            f"{path}: trans has shape {trans.shape} for {len(poses)} poses, expected (N, 3) with N >= 2 alike"
        )
    if rate.size != 1 or rate.dtype.kind not in "fiu":
        raise ValueError(f"{path}: the frame rate has shape {rate.shape} and type {rate.dtype}, expected one number")
    for key, values in (("poses", poses), ("trans", trans)):
        if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise ValueError(f"{path}: {key} (type {values.dtype}) holds values that are not finite numbers")
    turns = np.linalg.norm(poses[:, 3 : 3 * NUM_JOINTS].reshape(len(poses), -1, 3), axis=2)
    if turns.max() > GREATEST_TURN:
        raise ValueError(
            f"{path}: a joint turns by {turns.max():.3g} rad in frame {turns.max(axis=1).argmax()}, it must be <= "
            f"{GREATEST_TURN:.3g}; poses may be in degrees, and must be in radians"
        )
    return poses[:, : 3 * NUM_JOINTS].astype(np.float64), trans.astype(np.float64), float(rate.reshape(()))
