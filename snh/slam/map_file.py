"""A finished map on disk: one .npz of plain arrays (no pickle), the configuration and the keyframes' poses inside."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import torch

from snh.config import Config
from snh.errors import DataError
from snh.files import write_atomically
from snh.nn import SceneField
from snh.slam.system import SLAM, field_spec


def save_map(path: Path, slam: SLAM, config: Config) -> None:
    """Writes the field of a run. Raises OutputError when it cannot."""
    arrays = {name: value.cpu().numpy() for name, value in slam.field.state_dict().items()}
    buffer = io.BytesIO()
    np.savez(buffer, config=json.dumps(config.to_dict()), keyframes_T_wc=slam.keyframes.T_wc, **arrays)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())


def load_map(path: Path) -> tuple[SceneField, Config, np.ndarray]:
    """The field, its configuration and the keyframes' poses [M, 4, 4]. Raises DataError for any other file."""
    if not path.is_file():
        raise DataError(f"there is no map at {path}; give the output folder of a finished 'snh-slam run'")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        config = Config().updated(json.loads(str(arrays.pop("config"))), str(path))
        poses = arrays.pop("keyframes_T_wc")
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} is not a map of snh-slam, or is damaged: {error}") from error
    field = SceneField(field_spec(config))
    field.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
    return field, config, poses
