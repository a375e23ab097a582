"""What the tests share: a small scene, and where the benchmark's data are."""

import os
import pathlib

import numpy as np
import pytest

import sci

REPOSITORY = pathlib.Path(__file__).resolve().parents[3]


def moving_square(frames, size=64):
    """A bright square on a ramp, one pixel further to the right in each frame, [T, H, W]."""
    ramp = np.linspace(0.1, 0.4, size, dtype=np.float32)
    video = np.broadcast_to(ramp, (frames, size, size)).copy()
    for t in range(frames):
        video[t, 16:40, 10 + t : 30 + t] = 0.9
    return video


class Scene:
    """A video, masks, and what is measured of it through them."""

    def __init__(self, measurements=1):
        self.masks = sci.random_masks((8, 64, 64), seed=1)
        self.truth = moving_square(8 * measurements)
        self.y = sci.simulate(self.truth, self.masks)

    def mean_psnr(self):
        """PSNR of the static video that explains the first measurement best, in dB."""
        static = self.y[0] / np.maximum(self.masks.sum(0), 1)
        return sci.psnr(self.truth[:8], np.broadcast_to(static, (8, 64, 64)))


@pytest.fixture(scope="session")
def scene():
    return Scene()


@pytest.fixture(scope="session")
def two():
    return Scene(measurements=2)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def traffic():
    """The first measurement of the benchmark's *traffic*: (y [H, W], masks, truth), white at 1."""
    folder = pathlib.Path(os.environ.get("SCI_DATA") or REPOSITORY.parent / "shared")
    path = folder / "data" / "traffic48.mat"
    if not path.exists():
        if os.environ.get("SCI_REQUIRE_DATA") == "1":
            pytest.fail(f"{path} is not there, and SCI_REQUIRE_DATA asks for it")
        pytest.skip(f"{path} is not there")
    io = pytest.importorskip("scipy.io")
    file = io.loadmat(path)
    masks = np.ascontiguousarray(file["mask"].transpose(2, 0, 1), dtype=np.float32)
    truth = np.ascontiguousarray(file["orig"].transpose(2, 0, 1)[:8] / 255, dtype=np.float32)
    return (masks * truth).sum(0), masks, truth
