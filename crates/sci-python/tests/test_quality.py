import numpy as np
import pytest

import sci


def test_psnr_is_the_mean_over_frames(rng):
    a = rng.uniform(size=(2, 9, 11)).astype(np.float32)
    b = a.copy()
    b[0] += 0.1
    b[1] += 0.01
    assert sci.psnr(a, b) == pytest.approx(30, abs=1e-3)
    assert sci.psnr(a[0], b[0]) == pytest.approx(20, abs=1e-3)
    assert sci.psnr(a, a) == np.inf
    color, other = rng.uniform(size=(2, 4, 3, 9, 11)).astype(np.float32)
    errors = ((color.astype(float) - other) ** 2).mean(axis=(1, 2, 3))
    assert sci.psnr(color, other) == pytest.approx(np.mean(-10 * np.log10(errors)), abs=1e-4)


def windowed_ssim(a, b, window, sample):
    """The formula, a window at a time."""
    side = window.shape[0]
    values = []
    for i in range(a.shape[0] - side + 1):
        for j in range(a.shape[1] - side + 1):
            p, q = (x[i : i + side, j : j + side].astype(float) for x in (a, b))
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq = (window * (p - mp) ** 2).sum() * sample, (window * (q - mq) ** 2).sum() * sample
            cov = (window * (p - mp) * (q - mq)).sum() * sample
            c1, c2 = 0.01**2, 0.03**2
            values.append((2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return np.mean(values)


def test_both_conventions_of_ssim(rng):
    a = rng.uniform(size=(18, 16)).astype(np.float32)
    b = np.clip(a + 0.1 * rng.normal(size=a.shape), 0, 1).astype(np.float32)
    uniform = np.full((7, 7), 1 / 49)
    line = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    gaussian = np.outer(line, line) / line.sum() ** 2
    assert sci.ssim(a, b) == pytest.approx(windowed_ssim(a, b, uniform, 49 / 48), abs=1e-5)
    assert sci.ssim(a, b, "gaussian") == pytest.approx(windowed_ssim(a, b, gaussian, 1), abs=1e-5)
    assert sci.ssim(a, a) == 1
    assert sci.ssim(a.T, b.T) == pytest.approx(sci.ssim(a, b), abs=1e-6)


def test_what_does_not_fit_is_a_value_error():
    for call, part in [
        (lambda: sci.psnr(np.zeros((4, 4)), np.zeros((4, 5))), "that of `reference`"),
        (lambda: sci.ssim(np.zeros((6, 6)), np.zeros((6, 6))), "at least a frame of 7×7"),
        (lambda: sci.ssim(np.zeros((8, 8)), np.zeros((8, 8)), "gaussian"), "at least a frame of 11×11"),
        (lambda: sci.ssim(np.zeros((8, 8)), np.zeros((8, 8)), "box"), "uniform"),
        (lambda: sci.psnr(np.zeros(4), np.zeros(4)), "expected"),
        (lambda: sci.psnr(np.zeros((2, 5, 4, 4)), np.zeros((2, 5, 4, 4))), "expected"),
    ]:
        with pytest.raises(ValueError, match=part):
            call()
