import threading

import numpy as np
import pytest

import sci


@pytest.fixture(scope="module")
def net():
    return sci.Denoiser("ffdnet", weights="bundled:ffdnet_gray")


def test_a_callable_does_what_our_denoiser_does(scene, net):
    stages = [(50 / 255, 3), (25 / 255, 3)]
    ours, info = sci.Gap(net).solve(scene.y[0], scene.masks, stages)
    calls = []

    def denoise(noisy, sigma):
        calls.append((noisy.shape, sigma))
        return net(noisy, sigma)

    theirs, other = sci.Gap(denoise).solve(scene.y[0], sci.MaskOperator(scene.masks), stages)
    np.testing.assert_array_equal(ours, theirs)
    assert info["stop"] == other["stop"] == "schedule_done" and info["iterations"] == 6
    assert info["relative_residual"] == other["relative_residual"]
    assert [shape for shape, _ in calls] == [(8, 1, 64, 64)] * 6
    assert [sigma for _, sigma in calls] == pytest.approx([50 / 255] * 3 + [25 / 255] * 3)
    assert sci.psnr(scene.truth, ours) > scene.mean_psnr() + 2


def test_gap_is_that_of_the_experiment(scene):
    tv = sci.Denoiser("tv", weight=0.3, inner=5)
    frames, _ = sci.reconstruct(scene.y[0], scene.masks, "gray/gap-tv", progress=False)
    ours, _ = sci.Gap(tv, momentum="zero").solve(scene.y[0], scene.masks, [(None, 40)], start="adjoint")
    np.testing.assert_array_equal(ours, frames)


def test_gap_of_no_denoiser_is_the_projection(scene):
    video, info = sci.Gap(lambda x, sigma: x, accelerate=False).solve(scene.y[0], scene.masks, [(None, 1)])
    open_pixels = sci.MaskOperator(scene.masks).gram > 0
    measured = sci.MaskOperator(scene.masks).forward(video)
    np.testing.assert_allclose(measured[open_pixels], scene.y[0][open_pixels], atol=1e-4)
    assert info["relative_residual"] < 1e-4


def test_admm_with_a_function(scene):
    def smooth(noisy, sigma):
        padded = np.pad(noisy, ((0, 0), (0, 0), (1, 1), (1, 1)), mode="edge")
        return (noisy * 4 + padded[..., :-2, 1:-1] + padded[..., 2:, 1:-1] + padded[..., 1:-1, :-2] + padded[..., 1:-1, 2:]) / 8

    video, info = sci.Admm(smooth, gamma=0.1).solve(scene.y[0], scene.masks, [(0.1, 40)])
    assert sci.psnr(scene.truth, video) > scene.mean_psnr() + 1 and info["iterations"] == 40
    again, _ = sci.Admm(smooth, gamma=0.1).solve(scene.y[0], scene.masks, [(0.1, 1)], start=video)
    assert sci.psnr(video, again) > 25


def test_color_solvers():
    masks = sci.random_masks((4, 32, 32), seed=2)
    rgb = np.broadcast_to(np.array([0.8, 0.4, 0.2], np.float32)[:, None, None], (4, 3, 32, 32)).copy()
    rgb[:, :, 8:20, 8:20] = 0.9
    y = sci.simulate(rgb, masks, cfa="grbg")[0]
    net = sci.Denoiser("ffdnet", weights="bundled:ffdnet_color", color=True)
    for solver in (sci.TwoStage(net), sci.TwoStage(net, convention="scaled", closed_form=True, tau=10), sci.Gap(net), sci.Admm(net)):
        video, _ = solver.solve(y, masks, [(50 / 255, 5), (25 / 255, 5)], cfa="grbg")
        assert video.shape == (4, 3, 32, 32) and sci.psnr(rgb, video) > 20, solver
    start, _ = sci.Gap(net).solve(y, masks, [], cfa="grbg")
    assert start.shape == (4, 3, 32, 32)
    with pytest.raises(ValueError, match="TwoStage is for color sensors"):
        sci.TwoStage(sci.Denoiser("tv")).solve(y, masks, [(None, 1)])


def test_what_the_denoiser_raises_is_raised(scene):
    class Mine(Exception):
        pass

    def denoise(noisy, sigma):
        raise Mine("out of order")

    with pytest.raises(Mine, match="out of order") as raised:
        sci.Gap(denoise).solve(scene.y[0], scene.masks, [(0.1, 3)])
    assert any("iteration 0" in note for note in getattr(raised.value, "__notes__", ["iteration 0"]))
    with pytest.raises(ValueError, match=r"returned shape \[64, 64\], expected \[8, 1, 64, 64\]"):
        sci.Gap(lambda x, s: x[0, 0]).solve(scene.y[0], scene.masks, [(0.1, 3)])


def test_a_denoiser_that_makes_nan_is_a_divergence(scene):
    video, info = sci.Gap(lambda x, s: x * np.nan, accelerate=False).solve(scene.y[0], scene.masks, [(0.1, 3)])
    assert info["stop"] == "diverged" and np.isfinite(video).all()


def test_the_denoiser_may_keep_what_it_is_given(scene):
    kept = []

    def denoise(noisy, sigma):
        kept.append(noisy)
        noisy *= 0.5
        return noisy

    sci.Gap(denoise).solve(scene.y[0], scene.masks, [(0.1, 3)])
    assert len({id(k) for k in kept}) == 3 and all(k.flags.owndata or k.base is not None for k in kept)


def test_callback_and_stops(scene, net):
    seen = []
    tv = sci.Denoiser("tv")
    _, info = sci.Gap(tv).solve(
        scene.y[0], scene.masks, [(None, 50)], callback=lambda i, video: seen.append(video.shape) or i == 2
    )
    assert info["stop"] == "observer" and seen == [(8, 64, 64)] * 3
    _, info = sci.Gap(tv).solve(scene.y[0], scene.masks, [(None, 1000)], relative_change=1e-2)
    assert info["stop"] == "converged" and info["iterations"] < 1000
    _, info = sci.Gap(tv).solve(scene.y[0], scene.masks, [(None, 100_000)], seconds=0.05)
    assert info["stop"] == "time_up"


def test_solves_on_several_threads(scene, net):
    expected, _ = sci.Gap(net).solve(scene.y[0], scene.masks, [(0.1, 3)])
    results = [None] * 4

    def solve(i):
        results[i] = sci.Gap(lambda x, s: net(x, s)).solve(scene.y[0], scene.masks, [(0.1, 3)])[0]

    threads = [threading.Thread(target=solve, args=(i,)) for i in range(4)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    for result in results:
        np.testing.assert_array_equal(result, expected)


def test_a_callback_that_calls_the_denoiser_at_work_fails(scene, net):
    shown = lambda i, video: net(video, 0.1) is None
    with pytest.raises(RuntimeError, match="at work"):
        sci.Gap(net).solve(scene.y[0], scene.masks, [(0.1, 2)], callback=shown)
    assert net(np.zeros((2, 8, 8), np.float32), 0.1).shape == (2, 8, 8)


def test_mistakes_are_value_errors(scene, net):
    tv = sci.Denoiser("tv")
    y, masks = scene.y[0], scene.masks
    for call, part in [
        (lambda: sci.Gap(3), "expected a sci.Denoiser or a callable"),
        (lambda: sci.Gap(tv, momentum="some"), 'momentum = "some" is not legal; legal: measurement, zero'),
        (lambda: sci.Gap(tv, demosaicer="some"), "legal: malvar, menon, bilinear"),
        (lambda: sci.Admm(tv, gamma=-1), "gamma = -1 is not legal"),
        (lambda: sci.TwoStage(tv, rho=0), "rho = 0 is not legal"),
        (lambda: sci.Gap(tv).solve(y, masks, [(0.1, 3)]), "has a strength of its own"),
        (lambda: sci.Gap(net).solve(y, masks, [(None, 3)]), "needs sigma"),
        (lambda: sci.Gap(net).solve(y, masks, [(25, 3)]), "sigma = 25 is not legal; legal: 0 to 1"),
        (lambda: sci.Gap(net).solve(y, masks, [(0.1, 3)], cfa="rggb"), "color=True"),
        (lambda: sci.Gap(tv).solve(y[:9], masks, [(None, 3)]), "64"),
        (lambda: sci.Gap(tv).solve(y * np.nan, masks, [(None, 3)]), "finite"),
        (lambda: sci.Gap(tv).solve(y, masks, [(None, 3)], start="none"), "legal"),
        (lambda: sci.Gap(tv).solve(y, masks, [(None, 3)], seconds=-1), "seconds"),
        (lambda: sci.Gap(tv).solve(y, masks, [(None, 3)], relative_change=-1), "relative_change"),
    ]:
        with pytest.raises(ValueError, match=part):
            call()
