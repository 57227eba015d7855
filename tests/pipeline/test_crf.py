import importlib.util
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.crf import AppearanceKernel, CrfParameters, SmoothnessKernel, mean_field
from pipeline.errors import InputError, RigError

ROOT = Path(__file__).parents[2]
_SPEC = importlib.util.spec_from_file_location("dense_crf", ROOT / "tests" / "oracles" / "dense_crf.py")
assert _SPEC is not None
assert _SPEC.loader is not None
dense_crf = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(dense_crf)

RECORDED = (
    Path(os.environ.get("CALIBWATCH_DATA", ROOT.parent / "shared" / "data")).parent / "reference" / "crf"
)
CASES = sorted(RECORDED.glob("[0-9][0-9]_*.npz"))


def lattice(unary, image, *, smoothness=None, appearance=None, iterations=5, class_weights=()):
    """Marginals by the code under test; kernels are told as the oracle wants them."""
    parameters = CrfParameters(
        smoothness=None if smoothness is None else SmoothnessKernel(*smoothness[0], smoothness[1]),
        appearance=None if appearance is None else AppearanceKernel(*appearance[0], *appearance[1:]),
        iterations=iterations,
        class_weights=class_weights,
    )
    return mean_field(unary, image, parameters)


def both(unary, image, **crf):
    """Marginals by the lattice and by brute force for the same CRF."""
    brute = {"smoothness": None, "appearance": None, "iterations": 5} | crf
    return lattice(unary, image, **crf), dense_crf.mean_field_exact(unary, image, **brute)


def recorded(path):
    """Unary, image, CRF, exact marginals, marginals of the reference implementation."""
    with np.load(path) as case:
        setting = json.loads(case["params"].item())
        smooth, like = setting["gauss"], setting["bilateral"]
        crf = {
            "smoothness": (tuple(smooth["sxy"]), smooth["compat"]) if smooth else None,
            "appearance": (tuple(like["sxy"]), tuple(like["srgb"]), like["compat"]) if like else None,
            "iterations": setting["iterations"],
        }
        return case["unary"], case["image"], crf, case["q_exact"], case["q_reference"]


def random_scene(rng, classes, height, width, noise=8.0):
    """Blocks of colour with noise, and a unary that is right at most pixels."""
    block = rng.integers(0, classes, (height // 4 + 1, width // 4 + 1))
    label = np.kron(block, np.ones((4, 4), int))[:height, :width]
    colour = rng.uniform(30, 220, (classes, 3))[label] + rng.normal(0, noise, (height, width, 3))
    probability = rng.dirichlet(np.ones(classes), (height, width)).transpose(2, 0, 1)
    probability += 0.7 * (np.arange(classes)[:, None, None] == label)
    unary = -np.log(probability / probability.sum(axis=0) + 1e-6)
    return unary.astype(np.float32), np.clip(colour, 0, 255).astype(np.uint8)


SMOOTH = ((2.0, 3.0), 2.0)
LIKE = ((12.0, 9.0), (14.0, 10.0, 20.0), 3.0)


@pytest.mark.recordings
@pytest.mark.skipif(not CASES, reason=f"no recorded CRF cases in {RECORDED}")
class TestRecordedCases:
    # The large cases take seconds each by brute force; the small ones hold every feature of the definition.
    @pytest.mark.parametrize("path", CASES[:4] + CASES[9:12] + CASES[13:16], ids=lambda path: path.stem)
    def test_brute_force_is_the_recorded_definition(self, path):
        unary, image, crf, exact, _ = recorded(path)
        assert np.abs(dense_crf.mean_field_exact(unary, image, **crf) - exact).max() < 1e-5

    @pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
    def test_no_case_is_worse_than_the_reference_implementation(self, path):
        unary, image, crf, exact, reference = recorded(path)
        got = lattice(unary, image, **crf)
        assert np.abs(got - exact).mean() <= 1.1 * np.abs(reference - exact).mean() + 1e-7
        assert np.mean(got.argmax(axis=0) != exact.argmax(axis=0)) <= 0.012

    def test_mean_over_all_cases(self):
        deviations = []
        for unary, image, crf, exact, _ in map(recorded, CASES):
            deviations.append(np.abs(lattice(unary, image, **crf) - exact).mean())
        assert len(deviations) == 18
        assert np.mean(deviations) < 0.002

    def test_lattice_gives_the_figures_of_the_reference_lattice(self):
        # Case 16 has the appearance kernel alone: the same lattice, so the same numbers, errors included.
        path = next(path for path in CASES if path.stem.startswith("16"))
        unary, image, crf, _, reference = recorded(path)
        assert np.abs(lattice(unary, image, **crf) - reference).max() < 1e-4


class TestAgainstBruteForce:
    @settings(max_examples=25, deadline=None)
    @given(
        seed=st.integers(0, 2**32 - 1),
        shape=st.tuples(st.integers(1, 4), st.integers(1, 20), st.integers(1, 20)),
        sigma=st.tuples(st.floats(0.3, 30.0), st.floats(0.3, 30.0)),
        compat=st.floats(0.0, 6.0),
    )
    def test_smoothness_is_exact(self, seed, shape, sigma, compat):
        classes, height, width = shape
        rng = np.random.default_rng(seed)
        unary = rng.uniform(0, 4, (classes, height, width)).astype(np.float32)
        image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        got, exact = both(unary, image, smoothness=(sigma, compat), iterations=2)
        assert np.abs(got - exact).max() < 1e-4

    @pytest.mark.parametrize("seed", range(6))
    def test_both_kernels_on_blocks_of_colour(self, seed):
        unary, image = random_scene(np.random.default_rng(seed), 3, 28, 36)
        got, exact = both(unary, image, smoothness=SMOOTH, appearance=LIKE)
        assert np.abs(got - exact).mean() < 0.005
        assert np.mean(got.argmax(axis=0) != exact.argmax(axis=0)) < 0.012

    def test_class_weights(self):
        unary, image = random_scene(np.random.default_rng(7), 3, 24, 24)
        weights = (1.0, 2.0, 0.25)
        got, exact = both(unary, image, smoothness=SMOOTH, class_weights=weights)
        assert np.abs(got - exact).max() < 1e-4
        assert np.abs(got - lattice(unary, image, smoothness=SMOOTH)).mean() > 0.02

    def test_order_of_classes_is_of_no_account(self):
        unary, image = random_scene(np.random.default_rng(8), 3, 24, 24)
        got, _ = both(unary, image, smoothness=SMOOTH, appearance=LIKE)
        turned, _ = both(unary[[2, 0, 1]], image, smoothness=SMOOTH, appearance=LIKE)
        np.testing.assert_allclose(turned, got[[2, 0, 1]], atol=1e-4)

    def test_order_of_channels_is_of_no_account(self):
        unary, image = random_scene(np.random.default_rng(20), 3, 24, 24)
        got, _ = both(unary, image, smoothness=SMOOTH, appearance=LIKE)
        sxy, (red, green, blue), compat = LIKE
        swapped = (sxy, (blue, red, green), compat)
        turned, exact = both(
            unary, np.ascontiguousarray(image[..., [2, 0, 1]]), smoothness=SMOOTH, appearance=swapped
        )
        # The lattice's directions are not those of the colours: equal but for its own error.
        assert np.abs(turned - got).mean() < 0.006
        assert np.abs(turned - exact).mean() < 0.005

    @pytest.mark.parametrize("axis", [0, 1])
    def test_a_mirrored_image_has_mirrored_marginals(self, axis):
        unary, image = random_scene(np.random.default_rng(21), 3, 24, 30)
        got, _ = both(unary, image, smoothness=SMOOTH, appearance=LIKE)
        mirrored = lattice(
            np.ascontiguousarray(np.flip(unary, axis + 1)),
            np.ascontiguousarray(np.flip(image, axis)),
            smoothness=SMOOTH,
            appearance=LIKE,
        )
        assert np.abs(np.flip(mirrored, axis + 1) - got).mean() < 0.006

    def test_a_constant_per_pixel_is_of_no_account(self):
        rng = np.random.default_rng(9)
        unary, image = random_scene(rng, 2, 20, 20)
        got, _ = both(unary, image, smoothness=SMOOTH, appearance=LIKE)
        raised, _ = both(
            unary + rng.uniform(-5, 5, (20, 20)).astype(np.float32), image, smoothness=SMOOTH, appearance=LIKE
        )
        np.testing.assert_allclose(raised, got, atol=1e-4)

    def test_sure_energies_do_not_overflow(self):
        unary = np.array([0.0, 3e4], np.float32)[:, None, None] * np.ones((2, 8, 8), np.float32)
        got, _ = both(unary, np.zeros((8, 8, 3), np.uint8), smoothness=SMOOTH, appearance=LIKE)
        np.testing.assert_array_equal(got[0], 1.0)

    def test_no_iteration_is_the_softmax(self):
        unary, image = random_scene(np.random.default_rng(10), 4, 9, 11)
        got, exact = both(unary, image, smoothness=SMOOTH, appearance=LIKE, iterations=0)
        np.testing.assert_allclose(got, exact, atol=1e-6)


class TestRegion:
    SMOOTH = ((2.0, 2.0), 2.0)
    PARAMETERS = CrfParameters(
        SmoothnessKernel(2.0, 2.0, 2.0), AppearanceKernel(10.0, 10.0, (13.0,) * 3, 3.0)
    )

    def test_smoothness_sees_the_pixels_that_stand_still(self):
        rng = np.random.default_rng(11)
        unary, image = random_scene(rng, 3, 30, 40)
        region = rng.random((30, 40)) < 0.3
        got = mean_field(unary, image, CrfParameters(SmoothnessKernel(2.0, 2.0, 2.0), None), region)
        crf = {"smoothness": self.SMOOTH, "appearance": None, "iterations": 5}
        exact = dense_crf.mean_field_exact(unary, image, **crf, region=region)
        np.testing.assert_allclose(got, exact, atol=1e-4)
        np.testing.assert_array_equal(
            got[:, ~region], mean_field(unary, image, CrfParameters(None, None))[:, ~region]
        )

    # At 4 px every fixed pixel takes part, at 10 px every ninth stands for its neighbours.
    @pytest.mark.parametrize(("sigma", "mean"), [(4.0, 0.006), (10.0, 0.012)])
    def test_appearance_sees_the_pixels_that_stand_still(self, sigma, mean):
        unary, image = random_scene(np.random.default_rng(12), 3, 44, 44)
        region = np.zeros((44, 44), dtype=bool)
        region[8:30, 10:24] = True
        like = ((sigma, sigma), (14.0, 14.0, 14.0), 3.0)
        got = mean_field(unary, image, CrfParameters(None, AppearanceKernel(*like[0], *like[1:])), region)
        crf = {"smoothness": None, "appearance": like, "iterations": 5}
        exact = dense_crf.mean_field_exact(unary, image, **crf, region=region)
        alone = dense_crf.mean_field_exact(
            np.ascontiguousarray(unary[:, 8:30, 10:24]), np.ascontiguousarray(image[8:30, 10:24]), **crf
        )
        deviation = np.abs(got - exact)[:, region].mean()
        assert deviation < mean
        # The pixels around matter: without them the answer is another one.
        assert np.abs(alone - exact[:, 8:30, 10:24]).mean() > 2.0 * deviation

    def test_kernel_far_wider_than_the_image(self):
        unary, image = random_scene(np.random.default_rng(13), 2, 12, 14)
        region = np.zeros((12, 14), dtype=bool)
        region[2:5, 3:9] = True
        wide = CrfParameters(None, AppearanceKernel(200.0, 200.0, (14.0,) * 3, 3.0))
        got = mean_field(unary, image, wide, region)
        np.testing.assert_allclose(got.sum(axis=0), 1.0, atol=1e-6)
        np.testing.assert_array_equal(
            got[:, ~region], mean_field(unary, image, CrfParameters(None, None))[:, ~region]
        )

    def test_all_pixels_and_none(self):
        unary, image = random_scene(np.random.default_rng(12), 2, 16, 16)
        everywhere = mean_field(unary, image, self.PARAMETERS, np.ones((16, 16), dtype=bool))
        np.testing.assert_array_equal(everywhere, mean_field(unary, image, self.PARAMETERS))
        nowhere = mean_field(unary, image, self.PARAMETERS, np.zeros((16, 16), dtype=bool))
        np.testing.assert_array_equal(nowhere, mean_field(unary, image, CrfParameters(None, None)))


class TestRefusals:
    UNARY = np.zeros((2, 4, 5), np.float32)
    IMAGE = np.zeros((4, 5, 3), np.uint8)
    PLAIN = CrfParameters(SmoothnessKernel(1.0, 1.0, 1.0), None)

    @pytest.mark.parametrize(
        ("unary", "image"),
        [
            (UNARY[0], IMAGE),
            (UNARY[:0], IMAGE),
            (UNARY, IMAGE[:3]),
            (UNARY, IMAGE.astype(np.float32)),
            (np.full_like(UNARY, np.nan), IMAGE),
            (np.full_like(UNARY, np.inf), IMAGE),
        ],
    )
    def test_input(self, unary, image):
        with pytest.raises(InputError):
            mean_field(unary, image, self.PLAIN)

    def test_region_of_another_shape(self):
        with pytest.raises(InputError, match="region"):
            mean_field(self.UNARY, self.IMAGE, self.PLAIN, np.ones((5, 4), dtype=bool))

    def test_class_weights_of_another_number(self):
        with pytest.raises(RigError, match="3 class weights for 2"):
            mean_field(self.UNARY, self.IMAGE, CrfParameters(None, None, class_weights=(1.0, 1.0, 1.0)))

    def test_kernel_too_narrow_for_its_keys(self):
        image = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
        narrow = CrfParameters(None, AppearanceKernel(1e-4, 1e-4, (1e-4,) * 3, 1.0))
        with pytest.raises(RigError, match="too narrow"):
            mean_field(self.UNARY, image, narrow)

    @pytest.mark.parametrize("width", [0.0, -1.0, np.nan, np.inf])
    def test_widths(self, width):
        with pytest.raises(RigError):
            SmoothnessKernel(width, 1.0, 1.0)
        with pytest.raises(RigError):
            AppearanceKernel(1.0, 1.0, (1.0, width, 1.0), 1.0)

    def test_weights_and_iterations(self):
        with pytest.raises(RigError):
            SmoothnessKernel(1.0, 1.0, -1.0)
        with pytest.raises(RigError):
            CrfParameters(None, None, iterations=-1)
        with pytest.raises(RigError):
            CrfParameters(None, None, class_weights=(1.0, -0.5))
