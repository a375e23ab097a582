import numpy as np
import pytest

import sci


@pytest.fixture
def masks(rng):
    return rng.uniform(size=(3, 17, 13)).astype(np.float32)


def test_forward_is_the_masked_sum(masks, rng):
    h = sci.MaskOperator(masks)
    x = rng.uniform(size=masks.shape).astype(np.float32)
    assert h.shape == (3, 17, 13)
    np.testing.assert_allclose(h.forward(x), (masks * x).sum(0), rtol=1e-6)
    np.testing.assert_allclose(h.gram, (masks**2).sum(0), rtol=1e-6)
    np.testing.assert_array_equal(h.masks, masks)


def test_adjoint_is_the_adjoint(masks, rng):
    h = sci.MaskOperator(masks)
    x, y = rng.normal(size=masks.shape), rng.normal(size=masks.shape[1:])
    left, right = np.vdot(h.forward(x).astype(float), y), np.vdot(x, h.adjoint(y).astype(float))
    assert abs(left - right) < 1e-5 * max(abs(left), abs(right))


def test_any_layout_and_number_type_gives_the_same(masks, rng):
    h = sci.MaskOperator(masks)
    x = rng.uniform(size=masks.shape).astype(np.float32)
    expected = h.forward(x)
    padded = np.zeros((6, 17, 26), np.float32)
    padded[::2, :, ::2] = x
    layouts = [np.asfortranarray(x), padded[::2, :, ::2], x[::-1, :, ::-1].copy()[::-1, :, ::-1], x.astype(np.float64)]
    for other in layouts:
        np.testing.assert_array_equal(h.forward(other), expected)
    frozen = x.copy()
    frozen.flags.writeable = False
    np.testing.assert_array_equal(h.forward(frozen), expected)
    bits = sci.random_masks((2, 8, 8))
    ones = np.ones((2, 8, 8), np.uint8)
    for kind in (bool, np.uint8, np.int64, np.float16):
        np.testing.assert_array_equal(sci.MaskOperator(bits.astype(kind)).forward(ones), bits.sum(0))


def test_masks_are_made_from_a_seed():
    a, b, c = (sci.random_masks((4, 32, 32), 0.25, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert (a != c).any() and set(np.unique(a)) == {0, 1} and abs(a.mean() - 0.25) < 0.05
    moving = sci.shifting_masks((4, 32, 32), 0.5, 3)
    np.testing.assert_array_equal(moving[1, :, :-1], moving[0, :, 1:])


def test_what_does_not_fit_is_a_value_error(masks):
    h = sci.MaskOperator(masks)
    for call, part in [
        (lambda: h.forward(np.zeros((3, 17, 14))), r"`video` has shape \[3, 17, 14\], expected \[3, 17, 13\]"),
        (lambda: h.forward(np.zeros((17, 13))), r"`video` has shape \[17, 13\], expected \[T, H, W\]"),
        (lambda: h.adjoint(np.zeros((13, 17))), "that of a mask"),
        (lambda: h.forward(np.zeros((3, 17, 13), complex)), "complex128, expected real numbers"),
        (lambda: h.forward("a text"), "expected real numbers"),
        (lambda: sci.MaskOperator(masks * 1e10), "mask"),
        (lambda: sci.MaskOperator(masks * np.nan), "mask"),
        (lambda: sci.random_masks((2, 8, 8), density=2), "density"),
        (lambda: sci.random_masks((2**20, 2**20, 2**20)), "at most"),
    ]:
        with pytest.raises(ValueError, match=part):
            call()


def test_a_camera_is_simulated(scene):
    np.testing.assert_allclose(scene.y[0], (scene.masks * scene.truth).sum(0), rtol=1e-5)
    noisy = sci.simulate(scene.truth, scene.masks, sigma=0.1, seed=5)
    assert abs((noisy - scene.y).std() - 0.1) < 0.01
    np.testing.assert_array_equal(noisy, sci.simulate(scene.truth, scene.masks, sigma=0.1, seed=5))
    lifted = sci.simulate(scene.truth, scene.masks, black=0.5)
    np.testing.assert_allclose(lifted, scene.y + 0.5, rtol=1e-5)
    with pytest.raises(ValueError, match="`contrast` = 3 is not legal"):
        sci.simulate(scene.truth, scene.masks, contrast=3)
    with pytest.raises(ValueError, match="cfa"):
        sci.simulate(scene.truth, scene.masks, cfa="rgbg")
    with pytest.raises(ValueError, match=r"expected \[T, H, W\]"):
        sci.simulate(scene.truth[0], scene.masks)


def test_masks_that_sit_elsewhere_are_found(scene):
    y = sci.simulate(scene.truth, scene.masks, shift=[0.0, 0.5])
    masks, found = sci.calibrate(y, scene.masks)
    assert found["shift"][1] == pytest.approx(0.5, abs=0.1)
    assert found["error_after"] < 0.5 * found["error_before"]
    assert masks.shape == scene.masks.shape
    with pytest.raises(ValueError, match="reach"):
        sci.calibrate(y, scene.masks, reach=100)
