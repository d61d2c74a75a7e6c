"""Every number of the method, typed and checked. A default is the paper's number (section IV-A unless said) with its
unit; what the paper leaves open says so. YAML files hold only differences; an unknown key names the nearest known one.
"""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from snh.errors import ConfigError


def _number(default: float | int, low: float, high: float = float("inf")) -> Any:
    return field(default=default, metadata={"low": low, "high": high})


def _choice(default: str, *options: str) -> Any:
    return field(default=default, metadata={"options": options})


@dataclass(frozen=True)
class MapConfig:
    """The scene representation (section III-A)."""

    n_levels: int = _number(6, 1, 16)
    finest_cell: float = _number(0.02, 1e-4)  # m, z_min
    coarsest_cell: float = _number(0.32, 1e-4)  # m, z_max
    n_features: int = _number(3, 1, 4)  # per vertex
    hull_scale: float = _number(1.1, 1.0)  # mu of eq. 2; the paper says > 1
    level_axes: bool = True  # turn the world to the main directions of the first view; datasets bring this with them
    allocation: str = _choice("hull", "hull", "surface", "frustum_box")
    hidden: int = _number(32, 8, 64)  # width of both hidden layers of both decoders, a multiple of 8
    n_geometry: int = _number(15, 1, 31)  # length of rho, eq. 5; open in the paper
    n_octaves: int = _number(5, 0, 12)  # of the positional encoding gamma; open in the paper
    base_wavelength: float = _number(8.0, 1e-3)  # m, of its first octave; open in the paper
    truncation: float = _number(0.06, 1e-4)  # m, T_r
    sharpness: float = _number(0.0, 0.0)  # of eq. 6, per unit of tsdf; 0 = 1 / truncation, the paper's reading
    cut_behind: bool = False  # drop rendering weights further than T_r behind the first surface

    @property
    def cell_sizes(self) -> tuple[float, ...]:
        """Side of the cells of each level, metres, finest first (eq. 3)."""
        if self.n_levels == 1:
            return (self.finest_cell,)
        ratio = (self.coarsest_cell / self.finest_cell) ** (1 / (self.n_levels - 1))
        return tuple(self.finest_cell * ratio**level for level in range(self.n_levels))


@dataclass(frozen=True)
class SamplingConfig:
    """Samples along a ray (section III-B)."""

    n_base: int = _number(36, 0, 512)
    n_surface: int = _number(12, 1, 512)
    near: float = _number(0.01, 0.0)  # of the base samples, times depth
    far: float = _number(1.2, 0.0)


@dataclass(frozen=True)
class TrackingConfig:
    """The pose of each frame (section III-D)."""

    tracker: str = _choice("adam", "adam", "gauss_newton")
    scheme: str = _choice("interframe", "interframe", "surface_only", "standard")  # Table V
    iterations: int = _number(15, 1)
    n_rays: int = _number(1024, 16)  # Q
    density: float = _number(1.0, 0.01)  # tau: samples per ray = tau * n_surface
    band: float = _number(0.06, 1e-4)  # m, half length of the sampled part of a ray: T_r
    lambda_color: float = _number(0.001, 0.0)  # lambda_ct of eq. 14
    learning_rate: float = _number(0.003, 0.0)  # per Adam step, m and rad; open in the paper
    robust_scale: float = _number(0.06, 1e-4)  # m, gauss_newton: residuals beyond it lose weight
    color_scale: float = _number(0.1, 1e-4)  # gauss_newton: colour differences (0..1) beyond it lose weight
    edge_depth: float = _number(0.05, 0.0)  # rays whose neighbour pixels differ more, relative to depth, are not used
    border: int = _number(4, 0)  # px at the image border that are not used


@dataclass(frozen=True)
class MappingConfig:
    """The field and the poses of the window (section III-C)."""

    every: int = _number(5, 1)  # frames
    iterations: int = _number(15, 1)
    first_iterations: int = _number(1500, 1)
    n_rays: int = _number(2048, 16)  # K
    lambda_color: float = _number(5.0, 0.0)
    lambda_depth: float = _number(0.1, 0.0)
    lambda_free_space: float = _number(10.0, 0.0)
    lambda_surface: float = _number(1000.0, 0.0)
    learning_rate_features: float = _number(0.01, 0.0)  # this and the next: supplementary, not available
    learning_rate_decoder: float = _number(0.01, 0.0)
    learning_rate_pose: float = _number(0.001, 0.0)
    first_learning_rate: float = _number(1.0, 0.0)  # factor on the map's rates during the first frame, falls to 1
    beta1: float = _number(0.9, 0.0, 1.0)
    beta2: float = _number(0.99, 0.0, 1.0)
    epsilon: float = _number(1e-15, 0.0)
    edge_depth: float = _number(0.0, 0.0)  # as in tracking; 0 = use every ray with depth
    final_iterations: int = _number(0, 0)  # refinement over all keyframes at the end of a run


@dataclass(frozen=True)
class KeyframeConfig:
    """Keyframe pixel library and window policy (section III-C)."""

    pixel_share: float = _number(0.05, 0.0, 1.0)  # of the valid pixels of a keyframe
    window: int = _number(10, 2)  # W, smallest
    window_share: float = _number(0.1, 0.0, 1.0)  # of the keyframes, when that is more
    neighbour_share: float = _number(0.2, 0.0, 1.0)  # of the window, nearest in time; the others are drawn
    policy: str = _choice("window", "window", "local", "random", "all_rays")  # Table VI


@dataclass(frozen=True)
class InputConfig:
    """What is taken from the sensor."""

    depth_min: float = _number(0.1, 0.0)  # m
    depth_max: float = _number(10.0, 0.1)  # m, further readings are dropped


@dataclass(frozen=True)
class MeshConfig:
    """The mesh at the end of a run."""

    voxel: float = _number(0.02, 1e-3)  # m, edge of a marching-cubes cell
    inside_views: bool = True  # only what lies in the view of a keyframe, seen or hidden; the map reaches further
    min_faces: int = _number(100, 0)  # connected pieces with fewer triangles are dropped


@dataclass(frozen=True)
class Config:
    map: MapConfig = field(default_factory=MapConfig)
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    input: InputConfig = field(default_factory=InputConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)

    def to_dict(self) -> dict[str, dict[str, Any]]:
        return dataclasses.asdict(self)

    def updated(self, changes: dict[str, Any], where: str = "config") -> Config:
        """This config with `changes` ({section: {key: value}}) applied, every value checked."""
        sections = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        for name, values in changes.items():
            _require_known(name, list(sections), where)
            if not isinstance(values, dict):
                raise ConfigError(f"{where}: section '{name}' must hold key: value lines, got {values!r}")
            sections[name] = _updated_section(sections[name], values, f"{where}: {name}")
        return Config(**sections)


def _require_known(name: str, known: list[str], where: str) -> None:
    if name in known:
        return
    near = difflib.get_close_matches(str(name), known, n=1, cutoff=0.0)
    raise ConfigError(f"{where}: unknown key '{name}'; did you mean '{near[0]}'?")


def _updated_section(section: Any, values: dict[str, Any], where: str) -> Any:
    fields = {f.name: f for f in dataclasses.fields(section)}
    for name, value in values.items():
        _require_known(name, list(fields), where)
        values = {**values, name: _checked(value, fields[name], getattr(section, name), f"{where}.{name}")}
    return dataclasses.replace(section, **values)


def _checked(value: Any, f: dataclasses.Field, current: Any, where: str) -> Any:
    kind = type(current)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if type(value) is not kind:
        raise ConfigError(f"{where} must be of type {kind.__name__}, got {value!r}")
    options = f.metadata.get("options")
    if options and value not in options:
        raise ConfigError(f"{where} must be one of {', '.join(options)}; got '{value}'")
    low, high = f.metadata.get("low"), f.metadata.get("high")
    if low is not None and not low <= value <= high:
        raise ConfigError(f"{where} must lie in [{low}, {high}], got {value}")
    return value


def preset_folder() -> Path:
    """Folder of the presets: beside the code when installed, the repository's configs/ otherwise."""
    here = Path(__file__).resolve().parent
    return here / "configs" if (here / "configs").is_dir() else here.parent / "configs"


def presets() -> list[str]:
    return sorted(path.stem for path in preset_folder().glob("*.yaml"))


def load_config(names: list[str], overrides: list[str] | None = None) -> Config:
    """Config from presets or YAML files, later ones over earlier ones, then `section.key=value` overrides.

    >>> load_config([], ["tracking.n_rays=512"]).tracking.n_rays
    512
    """
    config = Config()
    for name in names:
        path = Path(name) if name.endswith((".yaml", ".yml")) else preset_folder() / f"{name}.yaml"
        if not path.is_file():
            raise ConfigError(f"there is no preset or file '{name}'; the presets are {', '.join(presets())}")
        try:
            changes = yaml.safe_load(path.read_text()) or {}
        except yaml.YAMLError as error:
            raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
        if not isinstance(changes, dict):
            raise ConfigError(f"{path} must hold sections of key: value lines")
        config = config.updated(changes, str(path))
    for item in overrides or []:
        key, equals, text = item.partition("=")
        section, dot, name = key.partition(".")
        if not (equals and dot):
            raise ConfigError(f"override '{item}' must look like section.key=value, for example tracking.n_rays=512")
        config = config.updated({section: {name: yaml.safe_load(text)}}, "--set")
    return config
