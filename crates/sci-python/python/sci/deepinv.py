"""Video snapshot compressive imaging for deepinv: a physics of torch tensors. Needs torch and deepinv (`pip install sci-video[deepinv]`)."""

import torch
from deepinv.physics import LinearPhysics


class VideoSCI(LinearPhysics):
    r"""The forward model :math:`y = \sum_t C_t \odot x_t` of masks :math:`C`, plus noise.

    :math:`A A^\top` is diagonal, :math:`\sum_t C_t^2`, so that pseudo-inverse and proximal step have a closed form. It is made of torch
    operations: it runs on the device of its masks and can be differentiated through.

    :param masks: tensor or array `[T, H, W]`, transmittances; of a differential camera of both signs.
    :param channels: `"time"`, the default: videos are `[batch, T, H, W]`, as image denoisers with T channels and `sci` have them;
        `"video"`: `[batch, 1, T, H, W]`, as deepinv's video models have them. Measurements are `[batch, 1, H, W]`.
    :param kwargs: those of `deepinv.physics.LinearPhysics`, such as `noise_model` and `device`.
    """

    def __init__(self, masks, channels="time", device="cpu", **kwargs):
        masks = torch.as_tensor(masks, dtype=torch.float32, device=device)
        if masks.ndim != 3:
            raise ValueError(f"masks have shape {tuple(masks.shape)}, expected [T, H, W]")
        if channels not in ("time", "video"):
            raise ValueError(f"channels = {channels!r} is not legal; legal: 'time', 'video'")
        if not bool(torch.isfinite(masks).all()):
            raise ValueError("masks must be finite")
        self._time = 1 if channels == "time" else 2
        size = tuple(masks.shape)
        super().__init__(img_size=size if self._time == 1 else (1, *size), device=device, **kwargs)
        self.register_buffer("mask", masks)

    @property
    def gram(self):
        """diag(A Aᵀ) = Σ_t C_t², `[H, W]`."""
        return (self.mask**2).sum(0)

    def A(self, x, **kwargs):
        """The measurement `[batch, 1, H, W]` of videos."""
        y = (self.mask * x).sum(self._time)
        return y.unsqueeze(1) if self._time == 1 else y

    def A_adjoint(self, y, **kwargs):
        """C_t ⊙ y for each frame."""
        return self.mask * (y if self._time == 1 else y.unsqueeze(2))

    def A_dagger(self, y, **kwargs):
        """The pseudo-inverse Aᵀ y / diag(A Aᵀ): of the videos that explain y best, the least. Pixels that no mask opens are 0."""
        return self.A_adjoint(_divided(y, self.gram))

    def prox_l2(self, z, y, gamma, **kwargs):
        """argmin_x γ/2 ‖A x − y‖² + ½ ‖x − z‖², which is z + Aᵀ (y − A z) / (diag(A Aᵀ) + 1/γ)."""
        gamma = torch.as_tensor(gamma, dtype=z.dtype, device=z.device)
        gamma = gamma.reshape(gamma.shape + (1,) * (y.ndim - gamma.ndim)) if gamma.ndim else gamma
        return z + self.A_adjoint((y - self.A(z)) * gamma / (1 + gamma * self.gram))


def _divided(y, gram):
    open_pixels = gram > 0
    return torch.where(open_pixels, y / torch.where(open_pixels, gram, torch.ones_like(gram)), torch.zeros_like(y))
