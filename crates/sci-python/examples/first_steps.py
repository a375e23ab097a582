"""A tour of the module, without data: a clip is made, measured, reconstructed in four ways and judged.

    python first_steps.py [FOLDER]

prints what each way gives, and with matplotlib writes FOLDER/first_steps.png. It takes some ten seconds.
"""

import pathlib
import sys

import numpy as np

import sci

# %% A clip of 16 frames, [T, H, W] in 0..1: a disk and a bar that move over a textured ground.
T, SIZE = 16, 128
rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
ground = 0.35 + 0.15 * np.sin(columns / 5) * np.sin(rows / 9)
clip = np.empty((T, SIZE, SIZE), np.float32)
for t in range(T):
    frame = ground.copy()
    frame[(rows - 40) ** 2 + (columns - 30 - 3 * t) ** 2 < 18**2] = 0.9
    frame[(np.abs(rows - 90) < 6) & (np.abs(columns - 90 + 2 * t) < 25)] = 0.05
    clip[t] = frame

# %% A camera that sums 8 frames into one image, each through its own mask: two measurements [N, H, W].
masks = sci.random_masks((8, SIZE, SIZE), density=0.5, seed=0)
y = sci.simulate(clip, masks, sigma=1 / 255, seed=1)
print(f"{clip.shape} became {y.shape}")

# %% One call: the experiment "gray/default", a network that comes with the module.
frames, record = sci.reconstruct(y, masks, truth=clip, progress=False)
results = {"gray/default": frames}

# %% Any other experiment, any of its keys.
results["gray/gap-tv"], _ = sci.reconstruct(y, masks, "gray/gap-tv", denoiser={"weight": 0.2}, progress=False)

# %% The solver with a function of your own as its denoiser. It is given [T, C, H, W] and σ in 0..1.
def median_in_time(noisy, sigma):
    """Of each pixel and the frames before and after it the middle one; far from the best that can be done."""
    padded = np.concatenate([noisy[:1], noisy, noisy[-1:]])
    return np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)


solver = sci.Gap(median_in_time)
videos = [solver.solve(image, masks, [(None, 20)])[0] for image in y]
results["median, by hand"] = np.concatenate(videos)

# %% A loop of your own with our operator and our network: plain GAP.
H = sci.MaskOperator(masks)
denoise = sci.Denoiser("ffdnet", weights="bundled:ffdnet_gray")
gram = np.maximum(H.gram, 1)
videos = []
for image in y:
    v = H.adjoint(image / gram)
    for sigma in [50, 40, 30, 25, 20, 15, 12, 10, 8, 6]:
        x = v + H.adjoint((image - H.forward(v)) / gram)
        v = denoise(x, sigma / 255)
    videos.append(v)
results["FFDNet, own loop"] = np.concatenate(videos)

# %% Both conventions of SSIM.
for name, video in results.items():
    psnr = sci.psnr(clip, video)
    uniform, gaussian = sci.ssim(clip, video), sci.ssim(clip, video, "gaussian")
    print(f"{name:18} {psnr:6.2f} dB   SSIM {uniform:.4f} (uniform), {gaussian:.4f} (Gaussian)")

# %% Pictures.
if len(sys.argv) > 1:
    try:
        from matplotlib import pyplot
    except ImportError:
        sys.exit("the picture needs matplotlib")
    folder = pathlib.Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    shown = {"measured": y[0] / masks.sum(0).max(), **{name: video[3] for name, video in results.items()}, "truth": clip[3]}
    figure, axes = pyplot.subplots(1, len(shown), figsize=(2.2 * len(shown), 2.6), layout="constrained")
    for axis, (name, image) in zip(axes, shown.items()):
        axis.imshow(image, cmap="gray", vmin=0, vmax=1)
        axis.set_title(name, fontsize=9)
        axis.axis("off")
    figure.savefig(folder / "first_steps.png", dpi=100)
    print(f"wrote {folder / 'first_steps.png'}")
