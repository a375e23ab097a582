import _thread
import json
import subprocess
import sys
import threading
import time
import warnings

import numpy as np
import pytest

import sci

QUICK = {"config": "gray/gap-tv", "progress": False}


def test_frames_and_a_record(scene):
    frames, record = sci.reconstruct(scene.y[0], scene.masks, truth=scene.truth, **QUICK)
    assert frames.shape == (8, 64, 64) and frames.dtype == np.float32
    (m,) = record["measurements"]
    assert m["psnr_db"] == pytest.approx(sci.psnr(scene.truth, frames), abs=1e-6)
    assert m["ssim"] == pytest.approx(sci.ssim(scene.truth, frames), abs=1e-6)
    assert m["ssim_gaussian"] == pytest.approx(sci.ssim(scene.truth, frames, "gaussian"), abs=1e-6)
    assert m["psnr_db"] > scene.mean_psnr() + 2
    assert m["stop"] == "schedule_done" and m["iterations"] == 40 == len(m["trace"]["psnr_db"])
    assert record["experiment"] == "gray/gap-tv" and record["config"]["denoisers"][0]["weight"] == 0.3


def test_several_measurements_are_one_video(two):
    frames, record = sci.reconstruct(two.y, two.masks, truth=two.truth, **QUICK)
    assert frames.shape == (16, 64, 64) and len(record["measurements"]) == 2
    second, _ = sci.reconstruct(two.y[1], two.masks, **QUICK)
    np.testing.assert_array_equal(frames[8:], second)
    chosen, record = sci.reconstruct(two.y, two.masks, data={"measurements": [1]}, **QUICK)
    np.testing.assert_array_equal(chosen, second)
    assert record["measurements"][0]["index"] == 1 and record["measurements"][0]["psnr_db"] is None


def test_the_same_bits_as_the_command(two, tmp_path):
    np.savez(tmp_path / "scene.npz", mask=two.masks, meas=two.y, orig=two.truth)
    config, stage = "gray/default", [{"sigma": [20, 7], "iterations": 1}]
    command = [sys.executable, "-m", "sci", "run", config, "--set", f"data.path={tmp_path / 'scene.npz'}", "--out", tmp_path / "run"]
    sets = ["--set", "output=minimal", "--set", "stage=[{sigma=[20,7],iterations=1}]"]
    subprocess.run([*command, *sets], check=True, cwd=tmp_path)
    frames, record = sci.reconstruct(two.y, two.masks, config, two.truth, progress=False, stage=stage)
    np.testing.assert_array_equal(np.load(tmp_path / "run" / "recon.npy")[:, 0], frames)
    theirs = json.loads((tmp_path / "run" / "record.json").read_text())
    for ours, other in zip(record["measurements"], theirs["measurements"]):
        for name in ("psnr_db", "ssim", "ssim_gaussian", "relative_residual", "iterations", "gmac"):
            assert ours[name] == other[name], name


def test_an_experiment_file_of_ones_own(scene, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "bundled:gray/gap-tv.toml"\nname = "mine"\n[[stage]]\niterations = 7\n')
    for config in (path, str(path)):
        _, record = sci.reconstruct(scene.y, scene.masks, config, progress=False)
        assert record["experiment"] == "mine" and record["measurements"][0]["iterations"] == 7
    path.write_text('[solver]\nkind = "gap"\n[denoiser]\nkind = "tv"\nweight = 1e9\n[[stage]]\niterations = 7\n')
    with pytest.raises(ValueError, match=r"mine.toml:5: `denoiser.weight` = 1e9 is not legal; legal: a number from"):
        sci.reconstruct(scene.y, scene.masks, path, progress=False)


def test_settings_are_keys_of_the_file(scene):
    def config(**settings):
        return sci.reconstruct(scene.y, scene.masks, stage=[{"iterations": 1}], **settings, **QUICK)[1]["config"]

    assert config(denoiser={"weight": 0.5})["denoisers"][0]["weight"] == 0.5
    assert config(**{"denoiser.inner": np.int64(3)})["denoisers"][0]["inner"] == 3
    assert config(solver={"start": "mean", "accelerate": False, "kind": "gap"})["solver"]["accelerate"] is False
    assert config(stop={"seconds": 30})["stop"]["seconds"] == 30
    wnnm = {"kind": "wnnm"}
    resolved = sci.reconstruct(
        scene.y, scene.masks, denoiser=wnnm, stage=[{"sigma": [20, 10], "iterations": 1}], **QUICK
    )[1]["config"]
    assert resolved["denoisers"][0]["kind"] == "wnnm" and resolved["stage"][1]["sigma"] == pytest.approx(10 / 255)


def test_bytes_are_taken_as_bytes(scene):
    frames, _ = sci.reconstruct(scene.y, scene.masks, **QUICK)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stored, _ = sci.reconstruct((scene.y * 255).round().astype(np.uint16), scene.masks.astype(np.uint8) * 255, **QUICK)
    assert sci.psnr(frames, stored) > 45


def test_odd_scales_are_said(scene):
    with pytest.warns(UserWarning, match="white is taken to be"):
        frames, _ = sci.reconstruct(scene.y * 4095, scene.masks, **QUICK)
    assert frames.max() > 100


def test_color(rng):
    masks = sci.random_masks((4, 32, 32), seed=2)
    rgb = np.broadcast_to(np.array([0.8, 0.4, 0.2], np.float32)[:, None, None], (4, 3, 32, 32)).copy()
    rgb[:, :, 8:20, 8:20] = 0.9
    y = sci.simulate(rgb, masks, cfa="rggb")
    for truth in (rgb, rgb.transpose(0, 2, 3, 1)):
        frames, record = sci.reconstruct(y, masks, "color/gap-tv", truth, progress=False)
        assert frames.shape == (4, 3, 32, 32)
        assert record["measurements"][0]["psnr_rgb_db"] == pytest.approx(sci.psnr(rgb, frames), abs=1e-4)
    blind, _ = sci.reconstruct(y[0], masks, "color/gap-tv", data={"cfa": "rggb"}, progress=False)
    np.testing.assert_array_equal(blind, frames)


def test_mistakes_are_value_errors_with_what_is_legal(scene):
    y, masks = scene.y, scene.masks
    for call, part in [
        (lambda: sci.reconstruct(y, masks, "gray/defualt"), "gray/defualt"),
        (lambda: sci.reconstruct(y, masks, denoiser={"weigth": 1}, **QUICK), "weigth"),
        (lambda: sci.reconstruct(y, masks, denoiser={"weight": "much"}, **QUICK), "^`denoiser.weight` = .* is not legal; legal"),
        (lambda: sci.reconstruct(y, masks, seed=object(), **QUICK), "expected a number, a text"),
        (lambda: sci.reconstruct(y, masks, data={"measurements": [3]}, **QUICK), "names 3, but the scene has 1"),
        (lambda: sci.reconstruct(y, masks, data={"mask": "masks.npy"}, **QUICK), "`data.mask` has no effect on arrays"),
        (lambda: sci.reconstruct(y[:, :32], masks, **QUICK), "32×64 .* but `mask` is 64×64"),
        (lambda: sci.reconstruct(y * np.nan, masks, **QUICK), "must be finite"),
        (lambda: sci.reconstruct(y.astype(complex), masks, **QUICK), "expected real numbers"),
        (lambda: sci.reconstruct(y, masks, "color/gap-tv"), "the scene is gray"),
    ]:
        with pytest.raises(ValueError, match=part):
            call()


def test_progress_is_told(scene, capsys):
    told = []
    sci.reconstruct(scene.y, scene.masks, "gray/gap-tv", scene.truth, progress=lambda *args: told.append(args))
    assert [t[:3] for t in told] == [(0, i + 1, 40) for i in range(40)]
    assert told[-1][3] > told[0][3]
    sci.reconstruct(scene.y, scene.masks, "gray/gap-tv")
    assert "40/40" in capsys.readouterr().err
    sci.reconstruct(scene.y, scene.masks, **QUICK)
    assert capsys.readouterr().err == ""


def test_what_progress_raises_ends_the_solve(scene):
    class Enough(Exception):
        pass

    told = []

    def progress(*args):
        told.append(args)
        raise Enough

    with pytest.raises(Enough):
        sci.reconstruct(scene.y, scene.masks, "gray/gap-tv", progress=progress)
    assert len(told) == 1


LONG = {**QUICK, "stage": [{"iterations": 100_000}]}


def test_ctrl_c_ends_a_solve(scene):
    timer = threading.Timer(0.3, _thread.interrupt_main)
    timer.start()
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        sci.reconstruct(scene.y, scene.masks, **LONG)
    timer.join()
    assert time.monotonic() - begin < 20
    # And the next one works.
    sci.reconstruct(scene.y, scene.masks, **QUICK)


def test_other_threads_run_meanwhile(scene):
    counted = 0
    solving = threading.Event()

    def count():
        nonlocal counted
        while not solving.is_set():
            counted += 1
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    sci.reconstruct(scene.y, scene.masks, **QUICK, stop={"seconds": 0.3}, stage=[{"iterations": 100_000}])
    solving.set()
    thread.join()
    assert counted > 20


def test_experiments_are_listed():
    names = sci.experiments()
    assert {"gray/default", "color/default", "real/gray", "gray/gap-tv"} <= set(names)


def test_a_divergence_is_a_warning(tmp_path):
    path = tmp_path / "unstable.toml"
    path.write_text('[solver]\nkind = "two-stage"\ntau = 1\n[denoiser]\nkind = "tv"\n[[stage]]\niterations = 300\n')
    masks = sci.random_masks((4, 32, 32), seed=2)
    video = np.zeros((4, 3, 32, 32), np.float32) + np.array([0.8, 0.4, 0.2], np.float32)[:, None, None]
    y = sci.simulate(video, masks, cfa="rggb")
    with pytest.warns(RuntimeWarning, match="diverged in iteration"):
        frames, record = sci.reconstruct(y, masks, path, progress=False, data={"cfa": "rggb"})
    assert np.isfinite(frames).all() and record["measurements"][0]["stop"] == "diverged"
