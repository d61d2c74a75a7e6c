"""Presets, overrides and the errors of the configuration."""

import numpy as np
import pytest

from snh.config import Config, MapConfig, load_config, presets
from snh.errors import ConfigError


def test_defaults_are_the_papers_numbers():
    config = load_config(["paper"])
    assert config == Config()
    assert (config.map.n_levels, config.map.n_features, config.map.truncation) == (6, 3, 0.06)
    assert (config.sampling.n_base, config.sampling.n_surface) == (36, 12)
    assert (config.tracking.n_rays, config.tracking.iterations, config.tracking.lambda_color) == (1024, 15, 0.001)
    assert (config.mapping.n_rays, config.mapping.iterations, config.mapping.first_iterations) == (2048, 15, 1500)
    lambdas = config.mapping
    assert (lambdas.lambda_color, lambdas.lambda_depth) == (5, 0.1)
    assert (lambdas.lambda_free_space, lambdas.lambda_surface) == (10, 1000)


def test_levels_follow_equation_3_unrounded():
    sizes_cm = 100 * np.array(MapConfig().cell_sizes)
    np.testing.assert_allclose(sizes_cm, [2.00, 3.48, 6.06, 10.56, 18.38, 32.00], atol=0.005)
    assert MapConfig(n_levels=1).cell_sizes == (0.02,)


@pytest.mark.parametrize("name", presets())
def test_every_preset_loads(name):
    assert isinstance(load_config([name]), Config)


def test_later_files_and_overrides_win(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("mapping:\n  iterations: 7\n  every: 3\n")
    config = load_config(["fast", str(path)], ["mapping.every=2"])
    assert (config.mapping.iterations, config.mapping.every) == (7, 2)
    assert config.tracking.tracker == "gauss_newton"


@pytest.mark.parametrize(
    ("override", "part"),
    [
        ("traking.n_rays=3", "did you mean 'tracking'"),
        ("tracking.n_ray=3", "did you mean 'n_rays'"),
        ("tracking.n_rays=many", "type int"),
        ("tracking.n_rays=1.5", "type int"),
        ("tracking.n_rays=true", "type int"),
        ("map.hull_scale=0.5", "lie in [1.0"),
        ("map.truncation=.nan", "lie in"),
        ("tracking.tracker=magic", "one of adam, gauss_newton"),
        ("tracking=3", "section.key=value"),
    ],
)
def test_a_wrong_setting_is_one_sentence_that_helps(override, part):
    with pytest.raises(ConfigError) as error:
        load_config([], [override])
    assert part in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_no_configuration(tmp_path):
    path = tmp_path / "bad.yaml"
    for text in ("mapping: [1, 2\n", "- 1\n", "mapping: 3\n"):
        path.write_text(text)
        with pytest.raises(ConfigError):
            load_config([str(path)])
    with pytest.raises(ConfigError, match="presets are"):
        load_config(["absent"])
