"""Training clips and the cameras that measure them, as crates/nets/src/train/data.rs and camera.rs, drawn on the device."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

LUMA = (0.299, 0.587, 0.114)


def read_frames(paths, channels, device):
    """`[T, C, H, W]`, u8."""
    frames = torch.from_numpy(np.stack([np.asarray(Image.open(path).convert("RGB")) for path in paths]))
    if channels == 1:
        frames = (frames.float() @ torch.tensor(LUMA)).round()[..., None].to(torch.uint8)
    return frames.permute(0, 3, 1, 2).contiguous().to(device)


def read_clips(folder, channels, device):
    """A clip for each folder of pictures in a folder."""
    folders = sorted(path for path in Path(folder).iterdir() if path.is_dir())
    with ThreadPoolExecutor() as pool:
        clips = list(pool.map(lambda path: read_frames(sorted(path.iterdir()), channels, device), folders))
    if not clips:
        raise ValueError(f"{folder}: no folders of frames")
    return clips


def read_photos(folder, channels, device):
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda path: read_frames([path], channels, device)[0], sorted(Path(folder).iterdir())))


class Clips:
    """Crops of videos, and photographs that a synthetic camera moves, with flips, rotations, reversal and other exposures."""

    def __init__(self, videos, photos, photo_share, patch, device, rng):
        self.videos, self.photos, self.share = videos, photos, photo_share
        self.patch, self.device, self.rng = patch, device, rng

    def batch(self, count, frames):
        """`[count, T, C, P, P]` in [0, 1]."""
        clips = []
        for _ in range(count):
            clip = self.moving(frames) if self.rng.random() < self.share else self.crop(frames)
            clip = clip.flip([axis for axis in (0, 2, 3) if self.rng.random() < 0.5])
            if self.rng.random() < 0.5:
                clip = clip.transpose(2, 3)
            if self.rng.random() < 0.25:
                dark, bright = 0.25 * self.rng.random() * self.rng.random(), 1 - 0.5 * self.rng.random()
                clip = dark + max(bright - dark, 0.3) * clip
            clips.append(clip)
        return torch.stack(clips)

    def pick(self, items):
        return items[self.rng.integers(len(items))]

    def crop(self, frames):
        clip, p = self.pick(self.videos), self.patch
        n, _, h, w = clip.shape
        t0, y0, x0 = (self.rng.integers(0, max(have - want, 0) + 1) for have, want in ((n, frames), (h, p), (w, p)))
        times = [_mirrored(t, n) for t in range(t0, t0 + frames)]
        rows, columns = ([_mirrored(i, n) for i in range(first, first + p)] for first, n in ((y0, h), (x0, w)))
        if times[-1] == t0 + frames - 1 and rows[-1] == y0 + p - 1 and columns[-1] == x0 + p - 1:
            part = clip[t0 : t0 + frames, :, y0 : y0 + p, x0 : x0 + p]
        else:
            part = clip[times][:, :, rows][:, :, :, columns]
        return part.float() / 255

    def moving(self, frames):
        """A photograph seen by a moving camera, half the time with part of another one moving in front of it."""
        photo, p = self.pick(self.photos), self.patch
        clip, _ = self.seen(photo, 3.0, frames)
        if self.rng.random() < 0.5:
            front, moved = self.seen(self.pick(self.photos), 6.0, frames)
            centre, radii = p * (self.rng.random(2) - 0.5), p * self.rng.uniform(0.1, 0.4, 2)
            c = torch.arange(p, device=self.device) - 0.5 * p
            dy = (c[None, :, None] - centre[0] - moved[0][:, None, None]) / radii[0]
            dx = (c[None, None, :] - centre[1] - moved[1][:, None, None]) / radii[1]
            cover = (0.5 + 0.5 * (1 - torch.hypot(dy, dx)) * min(radii)).clamp(0, 1)[:, None]
            clip = clip + cover * (front - clip)
        return clip

    def seen(self, photo, fastest, frames):
        """A photograph at each time, through a camera on a smooth path, and how far that has moved."""
        h, w = photo.shape[1:]
        symmetric = lambda limit: limit * (2 * self.rng.random() - 1)
        centre = [0.5 * n + symmetric(0.5) * max(n - self.patch, 0) for n in (h, w)]
        # A product of two: slow motion is common.
        speed = fastest * abs(symmetric(1))
        velocity, acceleration = [symmetric(speed) for _ in "yx"], [symmetric(0.15) for _ in "yx"]
        time = torch.arange(frames, device=self.device) - 0.5 * (frames - 1)
        angle, scale = symmetric(0.01) * time, 1 + symmetric(0.01) * time
        moved = [v * time + 0.5 * a * time**2 for v, a in zip(velocity, acceleration)]
        c = torch.arange(self.patch, device=self.device) - 0.5 * self.patch
        sin, cos = (scale * angle.sin())[:, None, None], (scale * angle.cos())[:, None, None]
        y = centre[0] - moved[0][:, None, None] + cos * c[:, None] - sin * c[None, :]
        x = centre[1] - moved[1][:, None, None] + sin * c[:, None] + cos * c[None, :]
        grid = torch.stack([2 * x / (w - 1) - 1, 2 * y / (h - 1) - 1], -1)
        still = (photo.float() / 255)[None].expand(frames, -1, -1, -1)
        moving = F.grid_sample(still, grid, mode="bicubic", padding_mode="reflection", align_corners=True)
        return moving.clamp(0, 1), moved


def _mirrored(i, n):
    period = max(2 * (n - 1), 1)
    return min(i % period, period - i % period) if n > 1 else 0


class Cameras:
    """Measures each clip by a camera that is drawn anew: settings as `[camera]` of `sci train`."""

    def __init__(self, settings, device, rng):
        self.settings, self.device, self.rng = settings, device, rng

    def measure(self, video):
        """Of sensor videos `[b, T, H, W]` the masks as told and y, both 0 where nothing is measured."""
        told, y = zip(*(self.measure_one(clip) for clip in video))
        return torch.stack(told), torch.stack(y)

    def measure_one(self, clip):
        s, rng = self.settings, self.rng
        told, shown = self.masks(*clip.shape)
        y = (shown * clip).sum(0)
        if rng.random() < s.get("mask_errors", 0):
            told = self.mistold(told)
        noise = s.get("noise", 0) / 255
        most = noise if rng.random() < s.get("noisy", 0.5) else min(noise, 1 / 255)
        sigma, shot = most * rng.random(), rng.random()
        y = y + sigma * (1 - shot + shot * (y / y.mean().clamp(min=1e-6)).clamp(min=0)).sqrt() * torch.randn_like(y)
        kept = torch.rand_like(y) >= s.get("holes", 0) * rng.random()
        if rng.random() < s.get("saturated", 0):
            level = torch.quantile(y.flatten(), 1 - 0.1 * rng.random())
            if rng.random() < 0.5:
                kept &= y <= level
            y = torch.minimum(y, level)
        return told * kept, y * kept

    def masks(self, t, h, w):
        """As they are told, and as they are."""
        s, rng = self.settings, self.rng
        density, kinds = rng.uniform(*s["density"]), s.get("masks", ["random"])
        match kinds[rng.integers(len(kinds))]:
            case "random":
                masks = self.random((t, h, w), density)
            case "shifting":
                return self.shifting(t, h, w, density)
            case "blocky":
                side = rng.integers(2, 5)
                coarse = self.random((t, h // side + 2, w // side + 2), density)
                y, x = rng.integers(0, side, 2)
                masks = coarse.repeat_interleave(side, 1).repeat_interleave(side, 2)[:, y : y + h, x : x + w]
            case "hadamard":
                order = max(2, 1 << (t - 1).bit_length())
                rows = torch.randint(1, order, (h, w), device=self.device)
                both = rows & torch.arange(t, device=self.device)[:, None, None]
                masks = sum(both >> bit & 1 for bit in range(order.bit_length())).remainder(2).float()
            case "gray":
                masks = torch.rand((t, h, w), device=self.device)
                for _ in range(rng.integers(3)):
                    # Blurring takes two thirds of the contrast.
                    masks = (0.5 + 1.7 * (blurred(masks) - 0.5)).clamp(0, 1)
                masks = masks * (1 + 0.2 * (2 * torch.rand((t, 1, 1), device=self.device) - 1))
            case other:
                raise ValueError(f"camera.masks: {other!r} is not legal; legal: random, shifting, blocky, hadamard, gray")
        return masks, masks

    def random(self, shape, density):
        return (torch.rand(shape, device=self.device) < density).float()

    def shifting(self, t, h, w, density):
        """One pattern that moves by whole pixels, mostly by one; its grain, which is not told, moves with it."""
        rng = self.rng
        step = 1 if rng.random() < 0.7 else rng.integers(2, 4)
        dy, dx = ((step, 0), (0, step), (step, step))[rng.integers(3)]
        pattern = self.random((1, h + dy * (t - 1), w + dx * (t - 1)), density)
        places = range(t) if rng.random() < 0.5 else range(t - 1, -1, -1)
        move = lambda image: torch.cat([image[:, dy * k : dy * k + h, dx * k : dx * k + w] for k in places])
        told = move(pattern)
        grain = self.settings.get("mask_grain", 0) * rng.random()
        if grain == 0:
            return told, told
        return told, move(pattern * blurred(1 + 2 * grain * torch.randn(pattern.shape, device=self.device)).clamp(min=0))

    def mistold(self, masks):
        """As a calibration that is a little off has them: moved, each frame with a wrong gain, all with a pedestal."""
        (t, h, w), (dy, dx) = masks.shape, self.rng.uniform(-0.3, 0.3, 2)
        padded = F.pad(masks[None], (1, 1, 1, 1), mode="replicate")[0]
        at = lambda y, x: padded[:, 1 + y : 1 + y + h, 1 + x : 1 + x + w]
        y, x, ay, ax = int(np.sign(dy)), int(np.sign(dx)), abs(dy), abs(dx)
        moved = (1 - ay) * ((1 - ax) * masks + ax * at(0, x)) + ay * ((1 - ax) * at(y, 0) + ax * at(y, x))
        gains = 1 + 0.03 * (2 * torch.rand((t, 1, 1), device=self.device) - 1)
        return gains * moved + 0.01 * self.rng.random()


def blurred(images):
    """The mean of each pixel and the three to the right, below and across."""
    p = F.pad(images[None], (0, 1, 0, 1), mode="replicate")[0]
    return 0.25 * (p[:, :-1, :-1] + p[:, :-1, 1:] + p[:, 1:, :-1] + p[:, 1:, 1:])
