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
    network = gpu.Shiftnet(3 if color else 1, [32, 64, 64], [2, 2, 3], experts=[13, 9])
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


@pytest.mark.parametrize("settings", [SHIFTNET, FASTDVDNET])
def test_a_run_goes_on_where_it_was_stopped_and_the_program_reads_its_weights(settings, tmp_path, monkeypatch):
    from PIL import Image

    for folder in ("video/a", "photos"):
        (tmp_path / folder).mkdir(parents=True)
    for t, frame in enumerate(clip(5, 3, 40)):
        Image.fromarray((255 * frame).astype(np.uint8)).save(tmp_path / f"video/a/{t:03}.png")
        Image.fromarray((255 * frame).astype(np.uint8)).save(tmp_path / f"photos/{t}.png")
    (tmp_path / "tiny.toml").write_text(TRAINING.format(network=settings[0], more=settings[1]))
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["train", "tiny.toml", "--device", "cpu", *arguments])
        train.main()

    run()
    with pytest.raises(SystemExit, match="--resume"):
        run()
    (tmp_path / "tiny.toml").write_text((tmp_path / "tiny.toml").read_text().replace("steps = 2", "steps = 3"))
    run("--resume")
    assert torch.load(tmp_path / "runs/train-tiny/checkpoint.pt")["step"] == 3
    kind, weights = settings[0].split(chr(34))[1], str(tmp_path / "runs/train-tiny/tiny.safetensors")
    noisy = clip(4, 1, 16)[:, None, :, :, 0]
    assert np.isfinite(sci.Denoiser(kind, weights=weights)(noisy, 10 / 255)).all()
