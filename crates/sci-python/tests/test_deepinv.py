"""deepinv's own tests of a physics, on VideoSCI; skipped where torch and deepinv are not installed."""

import numpy as np
import pytest

import sci

torch = pytest.importorskip("torch")
deepinv = pytest.importorskip("deepinv")

from sci.deepinv import VideoSCI  # noqa: E402


@pytest.fixture(params=["time", "video"])
def setting(request):
    masks = sci.random_masks((4, 17, 13), seed=3) * 0.75
    masks[:, 0, 0] = 0
    physics = VideoSCI(masks, channels=request.param)
    x = torch.rand((2, 4, 17, 13) if request.param == "time" else (2, 1, 4, 17, 13), generator=torch.manual_seed(0))
    return masks, physics, x


def test_adjointness_as_deepinv_tests_it(setting):
    _, physics, x = setting
    assert abs(physics.adjointness_test(x)) < 1e-3


def test_norm_as_deepinv_tests_it(setting):
    masks, physics, x = setting
    # ‖A‖² is the largest entry of the diagonal of A Aᵀ.
    found = physics.compute_norm(x, max_iter=1000, tol=1e-6, verbose=False)
    assert float(found) == pytest.approx(float((masks**2).sum(0).max()), rel=1e-2)


def test_it_is_our_operator(setting):
    masks, physics, x = setting
    h = sci.MaskOperator(masks)
    y = physics.A(x)
    assert y.shape == (2, 1, 17, 13)
    for k in range(2):
        np.testing.assert_allclose(y[k, 0], h.forward(x[k].reshape(4, 17, 13)), rtol=1e-5)
        np.testing.assert_allclose(physics.A_adjoint(y)[k].reshape(4, 17, 13), h.adjoint(y[k, 0]), rtol=1e-5)
    np.testing.assert_allclose(physics.gram, h.gram, rtol=1e-6)


def test_pseudo_inverse(setting):
    _, physics, x = setting
    y = physics.A(x)
    torch.testing.assert_close(physics.A(physics.A_dagger(y)), y, rtol=1e-4, atol=1e-5)
    # Of all that explain y it is the least: A⁺ A A⁺ = A⁺.
    torch.testing.assert_close(physics.A_dagger(physics.A(physics.A_dagger(y))), physics.A_dagger(y), rtol=1e-4, atol=1e-5)
    assert torch.isfinite(physics.A_dagger(torch.ones_like(y))).all()


@pytest.mark.parametrize("gamma", [0.1, 10.0, "of each"])
def test_prox_is_the_minimum(setting, gamma):
    _, physics, x = setting
    gamma = torch.tensor([0.1, 10.0]) if gamma == "of each" else gamma
    z, y = torch.randn_like(x), physics.A(x)
    found = physics.prox_l2(z, y, gamma)
    # Where the gradient of γ/2 ‖A x − y‖² + ½ ‖x − z‖² is 0.
    weight = gamma.reshape((2,) + (1,) * (x.ndim - 1)) if torch.is_tensor(gamma) else gamma
    gradient = weight * physics.A_adjoint(physics.A(found) - y) + found - z
    assert float(gradient.abs().max()) < 1e-4 * max(1.0, float(torch.as_tensor(gamma).max()))


def test_gradients_go_through(setting):
    _, physics, x = setting
    x = x.clone().requires_grad_()
    physics.A(x).square().sum().backward()
    torch.testing.assert_close(x.grad, 2 * physics.A_adjoint(physics.A(x)).detach())


def test_mistakes():
    with pytest.raises(ValueError, match="expected"):
        VideoSCI(torch.ones(3, 3))
    with pytest.raises(ValueError, match="legal"):
        VideoSCI(torch.ones(2, 3, 3), channels="frames")
    with pytest.raises(ValueError, match="finite"):
        VideoSCI(torch.full((2, 3, 3), float("nan")))


def test_dpir_of_deepinv_on_traffic(traffic):
    """Its plug-and-play loop, on our physics and with our network as its denoiser, goes on from its start, if not far in eight iterations."""
    y, masks, truth = traffic
    physics = VideoSCI(masks)
    net = sci.Denoiser("ffdnet", weights="bundled:ffdnet_gray")

    class Ours(deepinv.models.Denoiser):
        def forward(self, x, sigma=None, **kwargs):
            level = float(torch.as_tensor(sigma).flatten()[0])
            return torch.from_numpy(net(x[0].numpy(), min(level, 1.0)))[None]

    model = deepinv.optim.DPIR(sigma=0.02, denoiser=Ours())
    with torch.no_grad():
        found = model(torch.from_numpy(y)[None, None], physics)
    start = physics.A_dagger(torch.from_numpy(y)[None, None])[0].numpy()
    before, after = sci.psnr(truth, start), sci.psnr(truth, found[0].numpy())
    assert after > before + 3, (before, after)
