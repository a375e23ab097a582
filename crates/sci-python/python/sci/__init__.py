"""Video from a single snapshot: reconstruction for snapshot compressive cameras.

A camera sums T fast frames, each through its own mask, into one image, y = Σ_t C_t ⊙ x_t + noise. This module recovers the frames:

>>> import sci
>>> frames, record = sci.reconstruct(y, masks)              # y [H, W], masks [T, H, W] -> frames [T, H, W]

Layouts everywhere: gray or mosaic video and masks [T, H, W], color video [T, 3, H, W], measurement [H, W]; float32 in and out without a
copy, other number types are converted. White is 1 and σ is from 0 to 1, but in the settings of `reconstruct`, which are those of experiment
files (σ from 0 to 255).

Work is done on all processors (RAYON_NUM_THREADS=N takes N threads; results do not depend on it), with the interpreter free for other
threads, and Ctrl-C ends it. The worker threads do not survive a fork: with multiprocessing use the start method "spawn".
"""

import os

# Candle's own threads would spin beside those that have the work.
os.environ.setdefault("CANDLE_NUM_THREADS", "1")

from ._sci import (  # noqa: E402
    Admm,
    Denoiser,
    Gap,
    MaskOperator,
    TwoStage,
    __version__,
    calibrate,
    experiments,
    psnr,
    random_masks,
    reconstruct,
    shifting_masks,
    simulate,
    ssim,
)

__all__ = [
    "Admm",
    "Denoiser",
    "Gap",
    "MaskOperator",
    "TwoStage",
    "__version__",
    "calibrate",
    "experiments",
    "psnr",
    "random_masks",
    "reconstruct",
    "shifting_masks",
    "simulate",
    "ssim",
]
