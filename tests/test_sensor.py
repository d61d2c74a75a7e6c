"""The sensor model, by its statistics on surfaces that are known exactly."""

from dataclasses import replace

import numpy as np
import pytest

from snh.datasets.sensor import ColorSensor, DepthSensor, axial_sigma, image_flow, incidence, outlines
from snh.frame import Camera

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FINE = replace(DepthSensor(), disparity_step=1e-4)


def wall(z: float) -> np.ndarray:
    return np.full((240, 320), z, np.float32)


def slope(angle_deg: float) -> np.ndarray:
    """Depth of a plane through (0, 0, 2), turned about the vertical."""
    normal = np.array([np.sin(np.radians(angle_deg)), 0, np.cos(np.radians(angle_deg))])
    facing = CAMERA.rays() @ normal
    return np.where(facing > 0.02, 2 * normal[2] / np.maximum(facing, 0.02), 0).astype(np.float32)


@pytest.mark.parametrize("z", [0.8, 2.0, 4.0])
def test_axial_noise_grows_with_the_square_of_depth(z):
    measured = FINE(wall(z), CAMERA, 0)
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    assert axial_sigma(np.float32(z)) == pytest.approx(sigma, rel=1e-5)
    assert measured.std() == pytest.approx(sigma, rel=0.02)  # 76800 readings: 0.26 % at one sigma
    assert measured.mean() == pytest.approx(z, abs=5 * sigma / np.sqrt(measured.size))


def test_depth_comes_in_eighths_of_a_pixel_of_disparity():
    measured = DepthSensor()(wall(3.0), CAMERA, 0)
    steps = 585 * 0.075 / measured.astype(np.float64) * 8
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-4)
    assert len(np.unique(measured)) < 20


@pytest.mark.parametrize(("z", "seen"), [(0.3, False), (0.6, True), (7.0, True), (9.0, False), (0.0, False)])
def test_range(z, seen):
    share = (DepthSensor()(wall(z), CAMERA, 0) > 0).mean()
    assert share > 0.99 if seen else share == 0


def test_grazing_surfaces_are_lost_and_slopes_kept():
    angle = np.degrees(incidence(slope(60), CAMERA))
    np.testing.assert_allclose(angle[120, 159:161], 60, atol=0.3)
    for plane_deg in (0, 45, 60):
        depth = slope(plane_deg)
        clear = (np.degrees(incidence(depth, CAMERA)) < 74) & (depth > 0.5) & (depth < 7)
        assert (FINE(depth, CAMERA, 0)[clear] > 0).mean() > 0.99
    depth = slope(60)
    steep = np.degrees(incidence(depth, CAMERA)) > 83
    assert steep.any() and (FINE(depth, CAMERA, 0)[steep] == 0).all()


def test_planes_have_no_outlines():
    steep = slope(78)[:, 113:220]
    assert np.ptp(steep) > 8  # m, and up to 10 % of the depth from pixel to pixel
    assert not outlines(steep).any()
    step = wall(2.0)
    step[:, 160:] = 2.2
    np.testing.assert_array_equal(np.flatnonzero(outlines(step).any(0)), [159, 160])


def test_projector_shadow_lies_left_of_near_objects():
    depth = wall(3.0)
    depth[60:180, 150:200] = 1.0
    lost = DepthSensor(edge_loss=0.0)(depth, CAMERA, 0) == 0
    width = 262.5 * 0.075 * (1 / 1.0 - 1 / 3.0)  # 13.1 pixels
    row = lost[100:140].mean(0)
    assert (row[150 - int(width) + 2 : 148] == 1).all()
    assert row[: 150 - int(width) - 3].max() < 0.05 and row[203:].max() < 0.05
    assert not lost[:50].any()


def test_outlines_are_torn():
    depth = wall(2.0)
    depth[:, 160:] = 2.5
    measured = replace(FINE, edge_loss=0.5)(depth, CAMERA, 0)
    edge = measured[:, 159:161]
    assert (edge == 0).mean() == pytest.approx(0.5, abs=0.08)
    kept = measured[:, 160][measured[:, 160] > 0]
    assert 0.05 < (kept < 2.25).mean() < 0.5  # some outline pixels show the other side
    assert np.abs(measured[:, :150] - 2).max() < 0.05


def test_frames_are_drawn_from_seed_and_index_alone():
    sensor = DepthSensor(seed=3)
    later = sensor(wall(2), CAMERA, 7)
    sensor(wall(1), CAMERA, 0)
    np.testing.assert_array_equal(later, sensor(wall(2), CAMERA, 7))
    assert (later != sensor(wall(2), CAMERA, 8)).any()
    assert (later != DepthSensor(seed=4)(wall(2), CAMERA, 7)).any()


def test_flow_of_known_motions():
    T = np.eye(4)
    T[0, 3] = 0.02
    np.testing.assert_allclose(image_flow(wall(2), CAMERA, np.eye(4), T)[..., 0], -262.5 * 0.02 / 2, atol=1e-3)
    T = np.eye(4)
    T[2, 3] = 0.1  # forward: the image grows by 2 / 1.9
    flow = image_flow(wall(2), CAMERA, np.eye(4), T)
    u = np.arange(320) - 159.5
    np.testing.assert_allclose(flow[0, :, 0], u * (2 / 1.9 - 1), atol=1e-3)


def test_blur_is_as_wide_as_the_shutter_says():
    rgb = np.zeros((20, 100, 3), np.uint8)
    rgb[:, 50:] = 200
    flow = np.zeros((20, 100, 2), np.float32)
    sensor = ColorSensor(exposure=0, shutter=0.5, noise=0)
    np.testing.assert_array_equal(sensor(rgb, 0, flow), rgb)
    flow[..., 0] = 20  # pixels per frame, so 10 while the shutter is open
    row = sensor(rgb, 0, flow)[10, :, 0].astype(int)
    changing = np.flatnonzero((row > 0) & (row < 200))
    assert 44 <= changing.min() <= 46 and 53 <= changing.max() <= 55
    assert (np.diff(row) >= 0).all() and row[49] + row[50] == pytest.approx(200, abs=30)


def test_exposure_drifts_slowly_and_noise_has_its_size():
    sensor = ColorSensor(seed=1)
    gains = np.array([sensor.gain(i) for i in range(600)])
    assert np.abs(np.diff(gains, axis=0)).max() < 0.01
    assert 0.1 < np.ptp(gains) < 2 * 0.15 * 1.2
    grey = np.full((240, 320, 3), 120, np.uint8)
    image = replace(sensor, exposure=0.0)(grey, 4).astype(float)
    assert image.std() == pytest.approx(np.hypot(2.0, 1 / np.sqrt(12)), rel=0.02)  # noise and rounding
    assert image.mean() == pytest.approx(120, abs=0.05)
    brighter = sensor(grey, 40).mean((0, 1))
    np.testing.assert_allclose(brighter, 120 * sensor.gain(40), atol=0.1)
