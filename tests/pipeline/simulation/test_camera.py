import dataclasses
import math

import numpy as np
import pytest

from pipeline import labels
from pipeline.cameras import project, undistort
from pipeline.errors import InputError
from pipeline.records import CameraModel
from pipeline.se3 import AXES_CAM_IN_VEHICLE, apply, inverse, transform
from pipeline.simulation import camera as simulated
from pipeline.simulation.camera import Look, optics_of, render
from pipeline.simulation.furniture import post
from pipeline.simulation.paint import Line, Paint
from pipeline.simulation.roadway import Roadway
from pipeline.simulation.scene import Light, Scene, SceneParameters, draw_scene
from pipeline.simulation.shadows import shadow_map
from pipeline.simulation.solids import Solids, upright
from pipeline.simulation.surface import STEP_M, RoadSurface
from pipeline.simulation.textures import draw_textures

PLAIN = Look(blur=0.05, vignetting=0.0, noise=0.0)
PINHOLE = CameraModel(
    "pinhole", np.array([[400.0, 0.0, 239.5], [0.0, 400.0, 79.5], [0.0, 0.0, 1.0]]), np.zeros(0), 480, 160
)
BARREL = CameraModel(
    "plumb_bob",
    np.array([[300.0, 0.0, 230.0], [0.0, 310.0, 85.0], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.05, 0.001, -0.001, 0.0]),
    480,
    160,
)


def street(poles=(), lines=(), wear=0.0):
    """A flat, straight, grassless road with what the test puts there, under a grey sky."""
    x = np.arange(-30.0, 300.0, STEP_M)
    zero = np.zeros(len(x))
    surface = RoadSurface(x, zero, zero, x, zero, -40.0, 40.0, 0.0, 5.0)
    light = Light(np.array([0.0, 0.0, 1.0]), 0.0, 0.8, 1.0)
    textures = draw_textures(np.random.default_rng(0))
    flat = dataclasses.replace(textures, **{n: 0 * getattr(textures, n) for n in ("rough", "fine")})
    return Scene(surface, Paint(tuple(lines), ()), wear, Solids.of(list(poles)), (), light, flat, 0.1, 0.0)


def ahead(height=1.6, pitch=0.0, yaw=0.0):
    R = upright(yaw, (-math.tan(-pitch), 0.0)) @ AXES_CAM_IN_VEHICLE
    return transform(R, np.array([0.0, 0.0, height]))


def take(scene, model, T, look=PLAIN, seed=0):
    shadows = shadow_map(scene, (-20.0, 100.0))
    return render(scene, shadows, optics_of(model), T, time=0.0, look=look, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def town():
    return draw_scene(SceneParameters(length=160.0), np.random.default_rng(4))


def in_town(scene):
    place, heading, _ = scene.surface.pose(5.0, scene.ego_left)
    return transform(upright(float(heading)) @ AXES_CAM_IN_VEHICLE, place + np.array([0.0, 0.0, 1.6]))


@pytest.mark.parametrize("model", [PINHOLE, BARREL])
def test_rays_are_those_of_the_lens(model):
    optics = optics_of(model)
    rng = np.random.default_rng(1)
    u, v = rng.integers(0, model.width, 200), rng.integers(0, model.height, 200)
    for k, (du, dv) in enumerate(simulated.GRID):
        exact = undistort(model, np.column_stack([u + du, v + dv]))
        np.testing.assert_allclose(optics.rays[k][:, v, u].T, exact, atol=2e-6)


def test_a_lens_that_folds_inside_the_image_is_refused():
    D = np.array([-0.9, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="folds"):
        optics_of(CameraModel("plumb_bob", PINHOLE.K, D, 480, 160))


@pytest.mark.parametrize("model", [PINHOLE, BARREL])
def test_poles_are_labelled_where_they_project_and_nowhere_else(model):
    poles = [
        post(np.array([x, y, 0.0]), 4.0, 0.08, lean)
        for x, y, lean in ((12.0, 3.0, (0.0, 0.03)), (20.0, -5.0, (0.02, -0.04)), (9.0, -1.0, (0.0, 0.0)))
    ]
    T = ahead(pitch=0.03, yaw=0.02)
    picture = take(street(poles), model, T)
    pole = picture.labels == labels.POLE
    far = np.full(pole.shape, np.inf)
    v, u = np.nonzero(pole)
    for k in poles:
        along = k.centre + np.linspace(-1.0, 1.0, 4000)[:, None] * k.half[2] * k.axes[:, 2]
        uv, inside = project(model, apply(inverse(T), along[along[:, 2] > 0.02]))
        uv = uv[inside]
        half = model.K[0, 0] * 0.08 / apply(inverse(T), k.centre[None])[0, 2]
        pixels = np.rint(uv[20:-20]).astype(int)
        assert pole[pixels[:, 1], pixels[:, 0]].mean() > 0.99
        beyond = np.min(np.hypot(u[:, None] - uv[::20, 0], v[:, None] - uv[::20, 1]), axis=1) - half
        far[v, u] = np.minimum(far[v, u], beyond)
        # Half a pixel within the outline everything is pole.
        for side in (-1.0, 1.0):
            near = np.rint(uv[20:-20] + np.array([side * (half - 0.75), 0.0])).astype(int)
            assert pole[near[:, 1], near[:, 0]].mean() > 0.97
    assert far[v, u].max() < 1.0


def test_a_thin_pole_covers_the_share_of_a_pixel_that_it_should():
    # A dark pole before a bright sky: the missing light measures its width and place below a pixel.
    for y in np.linspace(-0.3, 0.3, 7):
        pole = post(np.array([40.0, y, 0.0]), 9.0, 0.03, (0.0, 0.01), (0.0, 0.0, 0.0))
        bare, with_pole = (take(street(p), PINHOLE, ahead()) for p in ((), (pole,)))
        rows = slice(20, 60)
        linear = [(p.image.pixels[rows, 200:280, 1] / 255.0) ** 2.2 for p in (bare, with_pole)]
        scale = linear[1][:, :20].mean() / linear[0][:, :20].mean()  # the exposures differ a little
        missing = 1.0 - linear[1] / (scale * linear[0])
        missing[np.abs(missing) < 0.05] = 0.0
        assert missing.sum(axis=1).mean() == pytest.approx(400.0 * 0.06 / 40.0, abs=0.08)
        v, u = np.mgrid[20:60, 200:280]
        place = (missing * u).sum() / missing.sum()
        height = 1.6 - ((v * missing).sum() / missing.sum() - 79.5) * 40.0 / 400.0
        expected = 239.5 - 400.0 * (y + math.tan(0.01) * height) / 40.0
        assert place == pytest.approx(expected, abs=0.08)


def test_paint_is_labelled_where_it_lies():
    lines = (Line(1.8, 0.15), Line(-1.7, 0.12))
    picture = take(street(lines=lines), PINHOLE, ahead(pitch=0.05))
    camera = inverse(ahead(pitch=0.05))
    lane = picture.labels == labels.LANE
    for line in lines:
        s = np.linspace(6.0, 25.0, 500)
        middle = np.column_stack([s, np.full(500, line.d), np.zeros(500)])
        uv, inside = project(PINHOLE, apply(camera, middle))
        u, v = np.rint(uv[inside]).astype(int).T
        assert inside.sum() > 200
        assert lane[v, u].mean() > 0.97
        for off in (-0.35, 0.35):
            beside, seen = project(PINHOLE, apply(camera, middle + np.array([0.0, off, 0.0])))
            u, v = np.rint(beside[seen]).astype(int).T
            assert lane[v, u].mean() < 0.1
    grey = picture.image.pixels.mean(axis=2)
    assert grey[lane].mean() > 1.4 * grey[picture.labels == labels.ROAD].mean()


def test_leaving_out_what_is_out_of_sight_changes_nothing(town, monkeypatch):
    T = in_town(town)
    quick = take(town, PINHOLE, T)
    whole = (slice(0, 160), slice(0, 480))
    monkeypatch.setattr(
        simulated, "_windows", lambda solids, *_: [(k, *whole, 0.0) for k in range(len(solids))]
    )
    slow = take(town, PINHOLE, T)
    # A sliver below a pixel may show only to the rays that are cast later.
    assert (quick.labels != slow.labels).mean() < 1e-3
    assert (np.abs(quick.image.pixels.astype(int) - slow.image.pixels) > 2).mean() < 2e-3


def test_one_ray_is_enough_where_nothing_ends(town, monkeypatch):
    T = in_town(town)
    quick = take(town, PINHOLE, T)
    monkeypatch.setattr(simulated, "_busy", lambda grey, *_: np.ones(grey.shape[1:], dtype=bool))
    full = take(town, PINHOLE, T)
    assert (quick.labels != full.labels).mean() < 0.02
    assert np.abs(quick.image.pixels.astype(float) - full.image.pixels).mean() < 3.0


def test_the_same_seed_gives_the_same_picture(town):
    T, look = in_town(town), Look()
    first, again, other = (take(town, PINHOLE, T, look, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.image.pixels, again.image.pixels)
    np.testing.assert_array_equal(first.labels, other.labels)
    assert (first.image.pixels != other.image.pixels).mean() > 0.3


def test_pictures_have_the_statistics_of_pictures(town):
    picture = take(town, PINHOLE, in_town(town), Look())
    grey = picture.image.pixels.mean(axis=2)
    assert 80.0 < grey.mean() < 140.0
    assert 25.0 < grey.std() < 75.0
    assert (grey > 250).mean() < 0.1
    assert set(np.unique(picture.labels)) >= {1, 2, 3, 4, 5, 6, 7}
    lane, road = picture.labels == labels.LANE, picture.labels == labels.ROAD
    assert grey[lane].mean() - grey[road].mean() > 25.0


def test_the_sun_casts_the_shadow_of_a_pole():
    pole = post(np.array([12.0, 1.0, 0.0]), 4.0, 0.15, (0.0, 0.0))
    sun = np.array([0.0, 1.0, 1.0]) / math.sqrt(2.0)
    clear = dataclasses.replace(street([pole]), light=Light(sun, 0.8, 0.4, 0.0))
    grey = take(clear, PINHOLE, ahead()).image.pixels.mean(axis=2)
    # It lies to the right of the foot, as long as the pole is high.
    for y, shaded in ((-0.5, True), (-2.5, True), (-3.5, False), (2.5, False)):
        uv, _ = project(PINHOLE, apply(inverse(ahead()), np.array([[12.0, y, 0.0], [10.5, y, 0.0]])))
        (u, v), (u0, v0) = np.rint(uv).astype(int)
        assert (grey[v, u] < 0.85 * grey[v0, u0]) == shaded


def test_a_pixel_is_what_covers_most_of_it():
    votes = [
        [labels.POLE, labels.POLE, labels.SKY, labels.SKY],
        [labels.POLE, labels.SKY, labels.SKY, labels.SKY],
        [labels.LANE, labels.IGNORE, labels.IGNORE, labels.IGNORE],
        [labels.LANE, labels.LANE, labels.IGNORE, labels.IGNORE],
        [labels.IGNORE] * 4,
        [labels.OTHER, labels.OTHER, labels.OTHER, labels.POLE],
    ]
    expected = [labels.POLE, labels.SKY, labels.IGNORE, labels.LANE, labels.IGNORE, labels.OTHER]
    assert simulated._voted(np.array(votes, dtype=np.uint8)).tolist() == expected  # noqa: SLF001 - the rule alone


@pytest.mark.parametrize("radius", [0.04, 0.08, 0.15])
def test_poles_of_known_width_are_labelled_as_wide_and_as_many(radius):
    places = np.array([-6.0, -2.0, 1.5, 5.0])
    poles = [post(np.array([15.0, y, 0.0]), 6.0, radius, (0.0, 0.0)) for y in places]
    pole = take(street(poles), PINHOLE, ahead()).labels == labels.POLE
    rows = pole[20:70]
    starts = np.diff(np.pad(rows, ((0, 0), (1, 0))).astype(int), axis=1) == 1
    assert (starts.sum(axis=1) == len(places)).all()
    assert rows.sum(axis=1).mean() / len(places) == pytest.approx(400.0 * 2.0 * radius / 15.0, abs=0.6)


def test_paint_worn_away_is_road_and_what_is_half_gone_is_not_labelled():
    scene = dataclasses.replace(street(lines=[Line(0.0, 1.5)]), roadway=Roadway(wear=0.7))
    rough = draw_textures(np.random.default_rng(0))
    worn = take(dataclasses.replace(scene, textures=rough), PINHOLE, ahead(pitch=0.05)).labels
    whole = take(street(lines=[Line(0.0, 1.5)]), PINHOLE, ahead(pitch=0.05)).labels
    strip = whole == labels.LANE
    assert set(np.unique(worn[strip])) == {labels.LANE, labels.ROAD, labels.IGNORE}
    assert 0.1 < (worn[strip] == labels.LANE).mean() < 0.9
    assert not (worn[~strip] == labels.LANE).any()


def test_bloom_and_veil_add_light_and_leave_the_labels(town):
    T = in_town(town)
    bare = take(town, PINHOLE, T, PLAIN)
    hazy = take(town, PINHOLE, T, dataclasses.replace(PLAIN, bloom=0.05, veil=0.1))
    np.testing.assert_array_equal(bare.labels, hazy.labels)
    assert (hazy.image.pixels.astype(int) - bare.image.pixels).min() >= 0
    assert hazy.image.pixels.min() > 60
