import json
import pathlib
import shutil
import subprocess
import sys
import sysconfig

import numpy as np
import pytest

import sci


def run(*arguments, **options):
    return subprocess.run([sys.executable, "-m", "sci", *map(str, arguments)], capture_output=True, text=True, **options)


def test_the_command_comes_with_the_wheel():
    script = shutil.which("sci", path=sysconfig.get_path("scripts"))
    assert script, "pip has installed no sci"
    told = subprocess.run([script, "--version"], capture_output=True, text=True, check=True).stdout
    assert told == run("--version").stdout == f"sci {sci.__version__}\n"


def test_exit_codes_are_those_of_the_command(tmp_path):
    assert run("run").returncode == 2
    wrong = run("run", "gray/gap-tv", "--set", "denoiser.weight=-1")
    assert wrong.returncode == 2 and "legal: a number from" in wrong.stderr
    assert run("metrics", tmp_path / "a.npy", tmp_path / "b.npy").returncode == 1


@pytest.mark.parametrize("output, kind", [("tiff", np.float32), ("tiff16", np.uint16)])
@pytest.mark.parametrize("color", [False, True])
def test_result_stacks_have_the_axes_that_imagej_reads(output, kind, color, tmp_path):
    tifffile = pytest.importorskip("tifffile")
    masks = sci.random_masks((4, 24, 20), seed=2)
    video = np.random.default_rng(3).uniform(0.2, 0.8, size=(8, 24, 20)).astype(np.float32)
    if color:
        rgb = np.stack([video, video * 0.5, video * 0.25], axis=-1)
        np.savez(tmp_path / "scene.npz", mask=masks, rgb=rgb)
    else:
        np.savez(tmp_path / "scene.npz", mask=masks, orig=video)
    config = "color/gap-tv" if color else "gray/gap-tv"
    sets = [f"data.path={tmp_path / 'scene.npz'}", "output=minimal", "stage=[{iterations=2}]"]
    for name in ("npy", output):
        arguments = [part for s in [*sets[:1], *sets[2:], f"output={{format='{name}',frames=false,preview=false,report=false}}"] for part in ("--set", s)]
        done = run("run", config, *arguments, "--out", tmp_path / name)
        assert done.returncode == 0, done.stderr
    expected = np.load(tmp_path / "npy" / "recon.npy")
    with tifffile.TiffFile(tmp_path / output / "recon.tif") as file:
        assert file.is_imagej
        series = file.series[0]
        assert series.axes == ("TCYX" if color else "TYX")
        assert file.imagej_metadata["frames"] == 8
        assert file.imagej_metadata.get("channels", 1) == (3 if color else 1)
        stack = series.asarray()
    assert stack.dtype == kind and stack.shape == ((8, 3, 24, 20) if color else (8, 24, 20))
    values = stack.reshape(expected.shape)
    if kind is np.uint16:
        np.testing.assert_allclose(values / 65535, np.clip(expected, 0, 1), atol=1 / 65535)
    else:
        np.testing.assert_array_equal(values, expected)
