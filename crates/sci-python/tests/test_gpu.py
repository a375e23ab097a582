"""sci.gpu computes what sci computes, and its weights go both ways. Runs where torch is installed."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

import sci
from sci import gpu
from sci.gpu import train

WEIGHTS = Path(__file__).parents[2] / "nets" / "weights"


def clip(frames, channels, size, seed=0):
    t, y, x = np.meshgrid(np.arange(frames), np.arange(size), np.arange(size), indexing="ij")
    waves = [0.5 + 0.3 * np.sin(0.3 * (y + t) + 0.2 * x + c) * np.cos(0.25 * x - 0.4 * t) for c in range(channels)]
    return np.stack(waves, -1).astype(np.float32)


@pytest.mark.parametrize("color", [False, True])
def test_a_solve_is_that_of_the_program(color):
    from safetensors.torch import load_file

    kind = "color" if color else "gray"
    truth = clip(6, 3 if color else 1, 32)
    masks = sci.random_masks((6, 32, 32), seed=1)
    network = gpu.Shiftnet(3 if color else 1, [32, 64, 64], [2, 2, 3], window=3, experts=[13, 9])
    network.set({name: value.float() for name, value in load_file(WEIGHTS / f"shiftnet_{kind}_sci.safetensors").items()})
    video = torch.tensor(truth).permute(0, 3, 1, 2)
    cfa = gpu.cfa_planes("rggb", 32, 32) if color else None
    sensor = gpu.mosaic(video, cfa) if color else video[:, 0]
    y = (torch.tensor(masks) * sensor).sum(0)
    with torch.no_grad():
        ours = gpu.solve(network, torch.tensor(masks)[None], y[None], [20, 17, 14, 12, 10, 8, 7], cfa)[-1][0]
    settings = {"denoiser.precision": "f32", "data.scale": 1.0}
    if color:
        settings["data.cfa"] = "rggb"
    found, _ = sci.reconstruct(y.numpy(), masks, config=f"{kind}/fast", progress=False, **settings)
    expected = torch.tensor(found).reshape(ours.shape)
    assert (ours - expected).abs().max() < 1e-3


TRAINING = """
name = "tiny"
[network]
{network}
[data]
video = "video"
photos = "photos"
validation = "video"
patch = 16
batch = 1
{more}
[training]
steps = 2
learning_rate = 1e-3
"""
SHIFTNET = (
    'kind = "shiftnet"\nchannels = 1\nwidths = [16, 16, 16]\nblocks = [1, 1, 1]\nexperts = [10]',
    '[camera]\nframes = [2, 4]\ndensity = [0.3, 0.6]\nmasks = ["random", "shifting", "blocky", "hadamard", "gray"]\nnoise = 20\nsaturated = 0.5\n'
    "mask_errors = 0.5\nmask_grain = 0.1\n[iterates]\nsigmas = [20, 8]\ncalls = 2\nunrolled = true",
)
FASTDVDNET = ('kind = "fastdvdnet"\nchannels = 1\nwidths = [8, 8, 16]', "frames = 4\n[noise]\nsigma = [2, 50]")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with frames to train on."""
    from PIL import Image

    for name in ("video/a", "photos"):
        (tmp_path / name).mkdir(parents=True)
    for t, frame in enumerate(clip(5, 3, 40)):
        Image.fromarray((255 * frame).astype(np.uint8)).save(tmp_path / f"video/a/{t:03}.png")
        Image.fromarray((255 * frame).astype(np.uint8)).save(tmp_path / f"photos/{t}.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run_in(folder, settings, out):
    config = train.tomllib.loads(TRAINING.format(network=settings[0], more=settings[1]))
    (folder / out).mkdir(exist_ok=True)
    return train.Run(train.Training(config, folder, "cpu"), folder / out, None)


@pytest.mark.parametrize("settings", [SHIFTNET, FASTDVDNET])
def test_a_run_that_was_stopped_goes_on_as_it_would_have(settings, folder):
    straight = run_in(folder, settings, "straight")
    for _ in range(4):
        straight.step()
    stopped = run_in(folder, settings, "stopped")
    stopped.step(), stopped.step()
    stopped.save()
    torch.rand(7)
    resumed = run_in(folder, settings, "stopped")
    resumed.resume()
    resumed.step(), resumed.step()
    assert resumed.steps_done == 4
    for name, p in straight.params.items():
        torch.testing.assert_close(p, resumed.params[name], msg=name)
        torch.testing.assert_close(straight.average[name], resumed.average[name], msg=name)


@pytest.mark.parametrize("settings", [SHIFTNET, FASTDVDNET])
def test_the_program_reads_what_the_command_writes(settings, folder, monkeypatch):
    (folder / "tiny.toml").write_text(TRAINING.format(network=settings[0], more=settings[1]))
    monkeypatch.setattr("sys.argv", ["train", "tiny.toml", "--device", "cpu"])
    train.main()
    with pytest.raises(SystemExit, match="--resume"):
        train.main()
    kind, weights = settings[0].split('"')[1], str(folder / "runs/train-tiny/tiny.safetensors")
    noisy = clip(4, 1, 16)[:, None, :, :, 0]
    assert np.isfinite(sci.Denoiser(kind, weights=weights)(noisy, 10 / 255)).all()


@pytest.mark.parametrize("more", ["[training]\nblend = 0.5", "renew = 1", "[iterates]\nfirst = 1", "[camera]\nmaks = 1"])
def test_keys_that_are_not_heeded_are_refused(more):
    with pytest.raises(ValueError, match="one of sci train alone"):
        train.check_keys(train.tomllib.loads(more))


def test_a_larger_network_begins_as_the_smaller_one():
    small = gpu.Shiftnet(1, [16, 16, 16], [1, 1, 1], seed=1)
    for p in small.params.values():
        p.data.normal_(std=0.1)
    large = gpu.Shiftnet(1, [32, 48, 32], [1, 1, 1], window=3, experts=[10], seed=2)
    large.start_from(small.weights())
    video = torch.rand(1, 3, 1, 16, 16)
    for sigma in (20, 5):
        torch.testing.assert_close(small(video, sigma), large(video, sigma), atol=1e-4, rtol=0)
