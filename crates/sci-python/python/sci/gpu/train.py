"""`python -m sci.gpu.train FILE.toml`: the training of `sci train FILE.toml` on a GPU, hundreds of times as many clips in the same time.

It takes the same files, of a ShiftNet with `iterates.unrolled = true` and of a FastDVDnet with `[noise]`, and differs in this:

* The clips of a step have one number of frames, drawn from those in `camera.frames` that divide 8 `data.batch`, and are as many as make 8
  `data.batch` frames.
* The loss is PSNR, layers multiply in bf16 on a GPU, Muon takes the steps, no channel begins anew, and what is reported and saved is what is so every
  20 seconds: `training.loss`, `precision`, `optimizer` and `revive`, `[validation]` and `[checkpoint]` have no effect.
* A quarter of the clips is seen in another exposure. Weights are written in 16 bits.
* With `--minutes` training ends after that time instead of `training.steps`, the learning rate with it.
"""

import argparse
import math
import os
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch

from . import solver
from .data import Cameras, Clips, read_clips, read_photos
from .networks import Fastdvdnet, Shiftnet

try:
    import tomllib
except ImportError:  # before Python 3.11
    import tomli as tomllib

#: The keys of a file, by the table that they are in.
KEYS = {
    "": "name seed weights network data camera iterates noise training validation checkpoint",
    "data": "video photos validation photo_share patch frames batch",
    "camera": "frames density masks noise noisy holes saturated mask_errors mask_grain",
    "iterates": "sigmas start_iterations calls unrolled",
    "noise": "sigma",
    "training": "steps learning_rate final_learning_rate warmup average clip_norm loss precision optimizer revive",
}
#: mse below which a clip is as good as it needs to be, 45 dB.
GOOD = 3e-5
REPORT_SECONDS = 20


class Muon:
    """Steps of kernels between hidden layers with all singular values made equal; Adam for the rest (crates/nets/src/train/muon.rs)."""

    def __init__(self, params):
        self.alike, rest = {}, []
        for p in params:
            if p.dim() == 4 and min(p.shape[:2]) >= 16:
                self.alike.setdefault(tuple(p.shape), []).append(p)
            else:
                rest.append(p)
        self.momentum = {s: torch.zeros(len(ps), s[0], 9 * s[1], device=ps[0].device) for s, ps in self.alike.items()}
        self.adam = torch.optim.Adam(rest)

    @torch.no_grad()
    def step(self, rate):
        self.adam.param_groups[0]["lr"] = 0.5 * rate
        self.adam.step()
        for shape, ps in self.alike.items():
            # An expert that no call of this step asked has none.
            found = [torch.zeros_like(p) if p.grad is None else p.grad for p in ps]
            gradients = torch.stack([gradient.reshape(shape[0], -1) for gradient in found])
            m = self.momentum[shape].mul_(0.95).add_(gradients, alpha=0.05)
            for p, direction in zip(ps, _equalised(m)):
                p.data.add_(direction.reshape(shape), alpha=-rate)

    def state(self):
        return {"momentum": self.momentum, "adam": self.adam.state_dict()}

    def set_state(self, state):
        self.momentum = state["momentum"]
        self.adam.load_state_dict(state["adam"])


def _equalised(m):
    x = m / m.norm(dim=(1, 2), keepdim=True).clamp(min=1e-20)
    tall = x.shape[1] > x.shape[2]
    x = (x.transpose(1, 2) if tall else x).to(torch.bfloat16 if x.is_cuda else torch.float32)
    for _ in range(5):
        gram = x @ x.transpose(1, 2)
        x = 3.4445 * x + (-4.775 * gram + 2.0315 * gram @ gram) @ x
    return (x.transpose(1, 2) if tall else x).float() * (0.2 * math.sqrt(max(m.shape[1:])))


class Training:
    """What is trained, and on what."""

    def __init__(self, config, folder, device):
        check_keys(config)
        self.config, self.device, self.compiled = config, device, False
        self.rng = np.random.default_rng(config.get("seed", 0))
        data, network = config["data"], dict(config["network"])
        self.kind, self.channels = network.pop("kind"), network["channels"]
        seed = config.get("seed", 0)
        torch.manual_seed(seed)
        clips = read_clips(found("data.video", data["video"], folder), self.channels, device)
        share = data.get("photo_share", 0.5)
        photos = read_photos(found("data.photos", data["photos"], folder), self.channels, device) if share > 0 else []
        self.validation = read_clips(found("data.validation", data["validation"], folder), self.channels, device)
        self.clips = Clips(clips, photos, share, data["patch"], device, self.rng)
        if self.kind == "shiftnet":
            iterates = config["iterates"]
            if not iterates.get("unrolled") or "noise" in config:
                raise ValueError("iterates: on a GPU ShiftNet is trained with unrolled = true and without [noise]; other files: sci train")
            self.network = Shiftnet(**network, device=device, seed=seed)
            self.cameras = Cameras(config["camera"], device, self.rng)
        elif self.kind == "fastdvdnet" and "iterates" not in config:
            if network.pop("ends", "circular") != "circular" or "weights" in config:
                raise ValueError("on a GPU FastDVDnet is trained with circular ends, from random weights; other files: sci train")
            self.network = Fastdvdnet(**network, device=device, seed=seed)
        else:
            raise ValueError("on a GPU a ShiftNet is trained through solves, or a FastDVDnet on white noise; other files: sci train")
        if "weights" in config:
            self.network.start_from(read_weights(config["weights"], folder))

    def compile(self):
        self.compiled = True
        self.network.compile()
        solver.compile_kernels()

    def counts(self):
        """Clips and frames of a step."""
        images = 8 * self.config["data"]["batch"]
        if self.kind == "fastdvdnet":
            frames = self.config["data"].get("frames", 1)
        else:
            low, high = self.config["camera"]["frames"]
            legal = [n for n in range(low, high + 1) if images % n == 0]
            if not legal:
                raise ValueError(f"camera.frames = [{low}, {high}]: none divides 8 data.batch = {images}")
            frames = int(self.rng.choice(legal))
        return max(images // frames, 1), frames

    def loss(self):
        """Of a new batch, in dB."""
        with torch.no_grad():
            clean = self.clips.batch(*self.counts())
        if self.kind == "fastdvdnet":
            low, high = self.config["noise"]["sigma"]
            sigma = (low + (high - low) * torch.rand(len(clean), device=self.device)) / 255
            noisy = clean + sigma.reshape(-1, 1, 1, 1, 1) * torch.randn_like(clean)
            self.network.training = True
            return decibels(self.network(noisy, sigma), clean)
        sigmas, calls = self.config["iterates"]["sigmas"], self.config["iterates"].get("calls", 2)
        last = int(self.rng.integers(calls, len(sigmas) + 1))
        results = self.results(clean, sigmas[:last], self.cameras.measure, last - calls)[-calls:]
        # Each call weighs half as much as the one after it.
        shares = [0.5 ** (calls - 1 - k) / (2 - 0.5 ** (calls - 1)) for k in range(calls)]
        return sum(share * decibels(result, clean) for share, result in zip(shares, results))

    def results(self, clean, sigmas, measure, skip_gradient=0):
        cfa, sensor = None, clean[:, :, 0]
        if self.channels == 3:
            pattern = list(solver.PATTERNS)[self.rng.integers(4)]
            cfa = solver.cfa_planes(pattern, *clean.shape[-2:], device=self.device)
            sensor = solver.mosaic(clean, cfa)
        with torch.no_grad():
            masks, y = measure(sensor)
        start = self.config["iterates"].get("start_iterations", 0)
        return solver.solve(self.network, masks, y, sigmas, cfa, start, skip_gradient)

    @torch.no_grad()
    def validate(self):
        """PSNR of the validation clips: after the calls of a solve through binary masks, or at four σ."""
        # Each clip has a size of its own, for which compiling does not pay.
        with torch.compiler.set_stance("force_eager") if self.compiled else nullcontext():
            return self.scores()

    def scores(self):
        self.network.training, scores = False, []
        for clip in self.validation:
            clip = clip[None, :8, :, :240, :240].float() / 255
            clip = clip[..., : clip.shape[-2] // 8 * 8, : clip.shape[-1] // 8 * 8]
            generator = torch.Generator(self.device).manual_seed(1)
            if self.kind == "fastdvdnet":
                noise = torch.randn(clip.shape, generator=generator, device=self.device)
                sigmas = [torch.tensor([sigma / 255], device=self.device) for sigma in (6, 12, 25, 50)]
                results = [self.network(clip + sigma * noise, sigma) for sigma in sigmas]
            else:

                def measure(sensor):
                    masks = (torch.rand(sensor.shape, generator=generator, device=self.device) < 0.5).float()
                    return masks, (masks * sensor).sum(1)

                results = self.results(clip, self.config["iterates"]["sigmas"], measure)
            scores.append([-10 * torch.log10(((r - clip) ** 2).mean((2, 3, 4))).mean().item() for r in results])
        return np.mean(scores, 0)


def decibels(result, clean):
    return 10 * torch.log10(((result - clean) ** 2).mean((1, 2, 3, 4)) + GOOD).mean()


def check_keys(config):
    for table, known in KEYS.items():
        part = config if table == "" else config.get(table, {})
        for key in part:
            if key not in known.split():
                place = f"{table}.{key}" if table else key
                raise ValueError(f"{place} is no key, or one of sci train alone; legal here: {known.replace(' ', ', ')}")


def found(key, path, folder):
    """A file or folder beside the training file, in the current folder, or in SCI_DATA."""
    places = [place / path for place in (folder, Path(), Path(os.environ.get("SCI_DATA", "")))]
    for place in places:
        if place.exists():
            return place
    raise ValueError(f"{key} = {path!r}: not beside the file, not here, not in SCI_DATA")


def read_weights(path, folder):
    from safetensors.torch import load_file

    if path.startswith("bundled:"):
        raise ValueError(f"weights = {path!r}: on a GPU weights are a file; this one is crates/nets/weights/{path[8:]}.safetensors in the sources")
    return load_file(found("weights", path, folder))


def write_weights(path, weights):
    from safetensors.torch import save_file

    part = path.with_suffix(".tmp")
    save_file({name: value.half().cpu().contiguous() for name, value in weights.items()}, part)
    os.replace(part, path)


class Run:
    """A training run in a folder, with checkpoints."""

    def __init__(self, training, out, minutes):
        self.training, self.out, self.minutes = training, out, minutes
        self.params = training.network.params
        self.average = {name: p.detach().clone() for name, p in self.params.items()}
        self.muon = Muon(self.params.values())
        self.steps_done, self.seconds, self.began = 0, 0.0, None

    def part(self):
        """How much of the training is done."""
        if self.minutes:
            return self.elapsed() / (60 * self.minutes)
        return self.steps_done / self.training.config["training"]["steps"]

    def elapsed(self):
        return self.seconds + (time.time() - self.began if self.began else 0)

    def step(self):
        settings = self.training.config["training"]
        low, high = settings.get("final_learning_rate", 0), settings["learning_rate"]
        warm = min(1, (self.steps_done + 1) / max(settings.get("warmup", 0), 1))
        rate = warm * (low + (high - low) * 0.5 * (1 + math.cos(math.pi * min(self.part(), 1))))
        loss = self.training.loss()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.params.values(), settings.get("clip_norm", 1))
        self.muon.step(rate)
        decay = min(settings.get("average", 0.999), (1 + self.steps_done) / (10 + self.steps_done))
        with torch.no_grad():
            for name, p in self.params.items():
                self.average[name].lerp_(p.data, 1 - decay)
                p.grad = None
        self.steps_done += 1
        if self.began is None:
            # The first step compiles; the time that was given is for what comes after it.
            loss.item()
            self.began = time.time()
        return loss.detach(), norm.detach(), rate

    def with_average(self, act):
        """Calls `act` with the averaged weights in the network."""
        kept = {name: p.data for name, p in self.params.items()}
        for name, p in self.params.items():
            p.data = self.average[name]
        try:
            return act()
        finally:
            for name, p in self.params.items():
                p.data = kept[name]

    def save(self):
        name = self.training.config["name"]
        self.with_average(lambda: write_weights(self.out / f"{name}.safetensors", self.training.network.weights()))
        state = {"params": {name: p.data for name, p in self.params.items()}, "average": self.average, "muon": self.muon.state()}
        state |= {"step": self.steps_done, "seconds": self.elapsed(), "rng": self.training.rng.bit_generator.state}
        state |= {"stats": getattr(self.training.network, "stats", {}), "torch": torch.get_rng_state()}
        if self.training.device.startswith("cuda"):
            state["cuda"] = torch.cuda.get_rng_state(self.training.device)
        torch.save(state, self.out / "checkpoint.tmp")
        os.replace(self.out / "checkpoint.tmp", self.out / "checkpoint.pt")

    def resume(self):
        state = torch.load(self.out / "checkpoint.pt", map_location=self.training.device)
        self.training.network.set(state["params"])
        self.average, self.steps_done, self.seconds = state["average"], state["step"], state["seconds"]
        self.training.rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch"].cpu())
        if "cuda" in state and self.training.device.startswith("cuda"):
            torch.cuda.set_rng_state(state["cuda"].cpu(), self.training.device)
        self.muon.set_state(state["muon"])
        for name, value in state["stats"].items():
            self.training.network.stats[name].copy_(value)

    def go(self):
        losses, last = [], time.time()
        while self.part() < 1:
            loss, norm, rate = self.step()
            losses.append(loss)
            if self.part() >= 1 or time.time() - last > REPORT_SECONDS:
                mean, losses = torch.stack(losses).mean().item(), []
                if not math.isfinite(mean):
                    raise ValueError(f"diverged by step {self.steps_done}: a lower training.learning_rate; --resume goes on from the last checkpoint")
                scores = " ".join(f"{score:.2f}" for score in self.with_average(self.training.validate))
                print(f"{self.elapsed():7.1f} s  step {self.steps_done}  rate {rate:.1e}  loss {mean:.3f} dB  gradient {norm:.2f}  validation {scores} dB", flush=True)
                self.save()
                last = time.time()


def main():
    parser = argparse.ArgumentParser(prog="python -m sci.gpu.train", description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path, help="the training file, TOML")
    parser.add_argument("--out", type=Path, help="where to write [default: runs/train-NAME]")
    parser.add_argument("--minutes", type=float, help="train for so long instead of training.steps")
    parser.add_argument("--batch", type=int, help="instead of data.batch; as many as the GPU has memory for, 30 and more")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--resume", action="store_true", help="go on with the run in the folder")
    args = parser.parse_args()
    try:
        config = tomllib.loads(args.file.read_text())
        config["data"]["batch"] = args.batch or config["data"]["batch"]
        out = args.out or Path("runs") / f"train-{config['name']}"
        if out.exists() and any(out.iterdir()) and not args.resume:
            raise ValueError(f"{out} has a run: --resume goes on with it, --out writes elsewhere")
        run = Run(Training(config, args.file.parent, args.device), out, args.minutes)
        if args.resume:
            run.resume()
        out.mkdir(parents=True, exist_ok=True)
        if args.device.startswith("cuda"):
            torch.backends.cudnn.benchmark = True
            run.training.network.dtype = torch.bfloat16
            run.training.compile()
        run.go()
    except (OSError, ValueError, KeyError) as error:
        missing = isinstance(error, KeyError)
        sys.exit(f"error: {args.file}: {f'{error} is missing' if missing else error}")


if __name__ == "__main__":
    main()
