"""A finished map on disk: one .npz of plain arrays (no pickle), the configuration and the keyframes' poses inside."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from snh.config import Config
from snh.errors import DataError
from snh.files import write_atomically
from snh.frame import Camera
from snh.nn import SceneField
from snh.slam.keyframes import Views
from snh.slam.system import SLAM, field_spec


@dataclass(frozen=True)
class SavedMap:
    """What is needed to mesh or to query a finished run."""

    field: SceneField
    config: Config
    views: Views


def save_map(path: Path, slam: SLAM) -> None:
    """Writes the field of a run and what its keyframes looked at. Raises OutputError when it cannot."""
    arrays = {name: value.cpu().numpy() for name, value in slam.field.state_dict().items()}
    views = slam.keyframes.views()
    buffer = io.BytesIO()
    np.savez(
        buffer,
        config=json.dumps(slam.config.to_dict()),
        camera=json.dumps(asdict(views.camera)),
        keyframes_T_wc=views.T_wc,
        keyframes_reach=views.reach,
        **arrays,  # type: ignore[arg-type]
    )
    write_atomically(path, buffer.getvalue())


def load_map(path: Path) -> SavedMap:
    """Reads what `save_map` wrote. Raises DataError for any other file."""
    if not path.is_file():
        raise DataError(f"there is no map at {path}; give the output folder of a finished 'snh-slam run'")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        config = Config().updated(json.loads(str(arrays.pop("config"))), str(path))
        camera = Camera(**json.loads(str(arrays.pop("camera"))))
        views = Views(camera, arrays.pop("keyframes_T_wc"), arrays.pop("keyframes_reach"))
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} is not a map of snh-slam, or is damaged: {error}") from error
    field = SceneField(field_spec(config))
    field.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
    return SavedMap(field, config, views)
