"""Archives of arrays: what is damaged or of another type ends in one line with the file, in every reader of them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from agents.fit.recordings import read_recording
from piavatar_envs.avatar.body.sources.gaussian import _read_weights
from piavatar_envs.avatar.motion import load_motion

COUNT = 4
POSES = np.zeros((COUNT, 156))
POSES[:, 0] = 0.5 * np.pi
#: Arrays of a sound file, and its reader.
READERS = {
    "motion": (
        {"poses": POSES, "trans": np.zeros((COUNT, 3)), "mocap_framerate": np.array(120.0)},
        lambda path: load_motion(str(path)),
    ),
    "recording": (
        {
            "bone_position": np.zeros((COUNT, 22, 3)),
            "marker_position": np.zeros((COUNT, 2, 3)),
            "time": np.arange(float(COUNT)),
            "marker_particle": np.arange(2),
        },
        read_recording,
    ),
    "weights": ({"weights": np.full((COUNT, 22), 1.0 / 22.0)}, lambda path: _read_weights(path, COUNT)),
}
#: What stands in an array's place.
DAMAGE = {
    "bytes that are no array": lambda array: b"\x12damaged",
    "text": lambda array: array.astype(str),
    "bytes": lambda array: array.astype("S4"),
    "complex": lambda array: array.astype(complex),
    "dates": lambda array: np.zeros(array.shape, "M8[s]"),
    "records": lambda array: np.zeros(array.shape, [("a", "f4"), ("b", "i4")]),
    "objects": lambda array: np.full(array.shape, None, object),
    "nothing": lambda array: array.reshape(-1)[:0],
    "not a number": lambda array: np.full(array.shape, np.nan),
}


def write(path: Path, arrays: dict[str, np.ndarray | bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            stream = io.BytesIO()
            if not isinstance(array, bytes):
                np.save(stream, array, allow_pickle=True)
            archive.writestr(f"{name}.npy", array if isinstance(array, bytes) else stream.getvalue())
    return path


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize(("reader", "key"), [(name, key) for name, (arrays, _) in READERS.items() for key in arrays])
def test_an_array_of_something_else_is_refused_in_one_line(reader, key, damage, tmp_path):
    arrays, read = READERS[reader]
    read(write(tmp_path / "sound.npz", arrays))
    path = write(tmp_path / "damaged.npz", arrays | {key: DAMAGE[damage](arrays[key])})
    with pytest.raises(ValueError, match="damaged") as caught:
        read(path)
    assert "\n" not in str(caught.value)
