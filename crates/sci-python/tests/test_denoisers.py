import numpy as np
import pytest

import sci

from conftest import moving_square


@pytest.mark.parametrize(
    "kind, keys, sigma",
    [
        ("ffdnet", {"weights": "bundled:ffdnet_gray"}, 25 / 255),
        ("ffdnet", {"weights": "bundled:ffdnet_gray", "precision": "bf16", "flips": True}, 25 / 255),
        ("fastdvdnet", {"weights": "bundled:fastdvdnet_gray"}, 25 / 255),
        ("wnnm", {}, 25 / 255),
        ("tv", {"weight": 0.1}, None),
    ],
)
def test_noise_becomes_less(kind, keys, sigma, rng):
    clean = moving_square(5)
    noisy = clean + 25 / 255 * rng.normal(size=clean.shape).astype(np.float32)
    denoiser = sci.Denoiser(kind, **keys)
    assert denoiser.kind == kind and kind in repr(denoiser)
    found = denoiser(noisy, sigma)
    assert found.shape == clean.shape and found.dtype == np.float32
    assert sci.psnr(clean, found) > sci.psnr(clean, noisy) + 5
    np.testing.assert_array_equal(denoiser(noisy[:, None], sigma), found[:, None])


def test_color(rng):
    clean = np.stack([moving_square(3)] * 3, axis=1)
    noisy = clean + 0.1 * rng.normal(size=clean.shape).astype(np.float32)
    denoiser = sci.Denoiser("fastdvdnet", weights="bundled:fastdvdnet_color", color=True)
    assert sci.psnr(clean, denoiser(noisy, 0.1)) > sci.psnr(clean, noisy) + 5
    with pytest.raises(ValueError, match=r"expected \[T, 3, H, W\]"):
        denoiser(noisy[:, 0], 0.1)


def test_mistakes_are_value_errors():
    net = sci.Denoiser("ffdnet", weights="bundled:ffdnet_gray")
    frames = np.zeros((2, 16, 16), np.float32)
    for call, part in [
        (lambda: sci.Denoiser("bm3d"), '`denoiser.kind` = "bm3d" is not legal; legal: tv, wavelet, wnnm'),
        (lambda: sci.Denoiser("tv", weigth=1), "weigth"),
        (lambda: sci.Denoiser("tv", weight=-1), "^`denoiser.weight` = -1 is not legal; legal: a number from"),
        (lambda: sci.Denoiser("ffdnet"), "`denoiser.weights` is missing"),
        (lambda: sci.Denoiser("ffdnet", weights="bundled:none"), "bundled are bundled:"),
        (lambda: net(frames), "needs sigma"),
        (lambda: net(frames, 25), "legal: 0 to 1"),
        (lambda: net(frames[0], 0.1), r"`noisy` has shape \[16, 16\], expected \[T, 1, H, W\] or \[T, H, W\]"),
        (lambda: net(frames[:, None].repeat(3, 1), 0.1), "expected"),
        (lambda: net(frames[:0], 0.1), "expected"),
    ]:
        with pytest.raises(ValueError, match=part):
            call()
    with pytest.raises((ValueError, RuntimeError), match="a network for 3 channels"):
        sci.Denoiser("ffdnet", weights="bundled:ffdnet_color")
