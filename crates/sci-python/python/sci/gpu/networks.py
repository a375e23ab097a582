"""ShiftNet and FastDVDnet with the names, shapes and order of layers of crates/nets, so that weights go both ways."""

import math

import torch
import torch.nn.functional as F


class Network:
    """Parameters by name, and the numbers that layers multiply with (`dtype`)."""

    def __init__(self, device):
        self.params, self.dtype, self.device = {}, torch.float32, device

    def named(self, prefix):
        """Those whose names begin so, without that, in `dtype`."""
        return {name[len(prefix) :]: self._cast(p) for name, p in self.params.items() if name.startswith(prefix)}

    def _cast(self, p):
        if p.dim() < 4 or self.dtype == torch.float32:
            return p if p.dim() == 4 else p.to(self.dtype)
        return p.to(self.dtype, memory_format=torch.channels_last)

    def set(self, state):
        for name, p in self.params.items():
            p.data.copy_(state[name])


def he(generator, outputs, inputs):
    return torch.randn(outputs, inputs, 3, 3, generator=generator) * math.sqrt(2 / (9 * inputs))


# ------------------------------------------------------------------------------------------------------------ ShiftNet


def shiftnet_layers(shown, found, widths, blocks):
    """Steps between first and last layer, and name, inputs, outputs, bias and silence of all layers, as crates/nets/src/shiftnet/body.rs."""
    steps, layers = [], [("input", shown, widths[0], True, False)]

    def add_blocks(place, level):
        for k in range(blocks[level]):
            name, width = f"{place}.{k}", widths[level]
            steps.append(("block", name))
            layers.extend([(f"{name}.0", width, width, True, False), (f"{name}.1", width, width, True, True)])

    for level in (0, 1):
        add_blocks(f"enter{level}", level)
        steps.append(("down", f"down{level}"))
        layers.append((f"down{level}", widths[level], widths[level + 1], True, False))
    add_blocks("deepest", 2)
    for level in (1, 0):
        steps.append(("up", f"up{level}"))
        layers.append((f"up{level}", widths[level + 1], 4 * widths[level], False, True))
        add_blocks(f"leave{level}", level)
    layers.append(("output", widths[0], found, True, True))
    return steps, layers


def shift_in_time(h, inside):
    """A quarter of the channels from the frame before, a quarter from the one after; `inside` `[2, N, 1, 1, 1]` is 0 at the ends of clips."""
    quarter = h.shape[1] // 4
    before = torch.cat([h[:1, :quarter], h[:-1, :quarter]]) * inside[0]
    after = torch.cat([h[1:, quarter : 2 * quarter], h[-1:, quarter : 2 * quarter]]) * inside[1]
    return torch.cat([before, after, h[:, 2 * quarter :]], 1)


def shiftnet_body(steps, params, x, inside):
    def conv(name, h, stride=1):
        return F.conv2d(h, params[name + ".weight"], params.get(name + ".bias"), stride=stride, padding=1)

    h, above = conv("input", x), []
    for kind, name in steps:
        if kind == "block":
            h = h + conv(name + ".1", F.relu(conv(name + ".0", shift_in_time(h, inside))))
        elif kind == "down":
            above.append(h)
            h = F.relu(conv(name, h, 2))
        else:
            h = above.pop() + F.pixel_shuffle(conv(name, h), 2)
    return conv("output", h)


def place(channel, old, new):
    """Where a channel of `old` stands among `new`: each keeps its way through the shift in time."""
    old, new = old // 4, new // 4
    group = min(channel // max(old, 1), 2)
    return group * new + channel - group * old


def widened(own, weight, is_first):
    """A smaller layer within a larger one: its channels do not listen to the new ones. What the first layer is shown grows at its beginning."""
    new = own.detach().cpu().clone()
    rows = [place(o, weight.shape[0], own.shape[0]) for o in range(weight.shape[0])]
    if own.dim() == 1:
        new[rows] = weight
        return new
    has, wants = weight.shape[1], own.shape[1]
    columns = [wants - has + i if is_first else place(i, has, wants) for i in range(has)]
    for output, row in enumerate(rows):
        new[row] = 0
        new[row, columns] = weight[output]
    return new


class Shiftnet(Network):
    """See `nets::Shiftnet`. Called with a video `[b, T, C, H, W]`, sides multiples of 8, and a σ in 0..255 units."""

    def __init__(self, channels, widths, blocks, window=1, experts=(), device="cpu", seed=0):
        super().__init__(device)
        self.window, self.experts = window, list(experts)
        self.steps, layers = shiftnet_layers(4 * window * channels + 1, 4 * channels, widths, blocks)
        self.prefixes = ["", *(f"below{sigma}." for sigma in self.experts)]
        self.body = shiftnet_body
        generator, first = torch.Generator().manual_seed(seed), {}
        for name, inputs, outputs, bias, silent in layers:
            weight = he(generator, outputs, inputs)
            first[f"body.{name}.weight"] = weight.zero_() if silent else weight
            if bias:
                first[f"body.{name}.bias"] = torch.zeros(outputs)
        for prefix in self.prefixes:
            for name, value in first.items():
                self.params[prefix + name] = value.clone().to(device).requires_grad_()

    def start_from(self, state):
        """Begins with these weights, which may have fewer experts and channels."""
        bounds = sorted((int(n[5:].split(".")[0]) for n in state if n.startswith("below") and n.endswith("input.weight")), reverse=True)
        for k, prefix in enumerate(self.prefixes):
            # Those for the largest σ that this expert is for.
            largest = math.inf if k == 0 else self.experts[k - 1] - 0.5
            lower = [bound for bound in bounds if largest < bound]
            old = f"below{lower[-1]}." if lower else ""
            for name, p in self.params.items():
                if name.startswith(prefix + "body."):
                    weight = state[old + name[len(prefix) :]].float()
                    p.data.copy_(weight if weight.shape == p.shape else widened(p, weight, name.endswith("input.weight")))

    def expert(self, sigma):
        return self.prefixes[sum(sigma < bound - 1e-3 for bound in self.experts)]

    def __call__(self, video, sigma):
        b, t, c, h, w = video.shape
        if h % 8 or w % 8:
            raise ValueError(f"frames of {h}x{w} pixels: sides must be multiples of 8")
        x = F.pixel_unshuffle(video.reshape(b * t, c, h, w), 2)
        gray = (x - 0.5).reshape(b, t, 4 * c, h // 2, w // 2)
        nothing, noise = torch.zeros_like(gray[:, :1]), torch.full_like(gray[:, :, :1], sigma / 255)
        beside = [torch.cat([nothing, gray[:, :-1]], 1), torch.cat([gray[:, 1:], nothing], 1)] if self.window == 3 else []
        shown = torch.cat([*beside, gray, noise], 2).reshape(b * t, -1, h // 2, w // 2)
        inside = torch.ones(2, b, t, device=video.device, dtype=self.dtype)
        inside[0, :, 0] = inside[1, :, -1] = 0
        shown = shown.to(self.dtype, memory_format=torch.channels_last)
        params = self.named(self.expert(sigma) + "body.")
        found = self.body(self.steps, params, shown, inside.reshape(2, b * t, 1, 1, 1))
        return F.pixel_shuffle(x + found.float(), 2).reshape(b, t, c, h, w)

    def compile(self):
        self.body = torch.compile(shiftnet_body, dynamic=False)

    def weights(self):
        return {name: p.detach() for name, p in self.params.items()}


# ---------------------------------------------------------------------------------------------------------- FastDVDnet

#: Name, stride and whether batch norm and ReLU follow, as crates/nets/src/video.rs.
LAYERS = [
    ("inc.convblock.0", 1, True),
    ("inc.convblock.3", 1, True),
    ("downc0.convblock.0", 2, True),
    ("downc0.convblock.3.convblock.0", 1, True),
    ("downc0.convblock.3.convblock.3", 1, True),
    ("downc1.convblock.0", 2, True),
    ("downc1.convblock.3.convblock.0", 1, True),
    ("downc1.convblock.3.convblock.3", 1, True),
    ("upc2.convblock.0.convblock.0", 1, True),
    ("upc2.convblock.0.convblock.3", 1, True),
    ("upc2.convblock.1", 1, False),
    ("upc1.convblock.0.convblock.0", 1, True),
    ("upc1.convblock.0.convblock.3", 1, True),
    ("upc1.convblock.1", 1, False),
    ("outc.convblock.0", 1, True),
    ("outc.convblock.3", 1, False),
]
#: Layers whose result is shuffled onto that of an earlier one.
ONTO = {10: 4, 13: 1}
EPSILON = 1e-5


def fastdvdnet_block(params, stats, x, training):
    results = []
    for i, (name, stride, hidden) in enumerate(LAYERS):
        x = F.conv2d(x, params[name + ".weight"], stride=stride, padding=1, groups=3 if i == 0 else 1)
        if hidden:
            mean, variance = stats[name + ".mean"], stats[name + ".variance"]
            gain, bias = params[name + ".gain"].float(), params[name + ".bias"].float()
            x = F.relu(F.batch_norm(x, mean, variance, gain, bias, training, 0.02, EPSILON))
        if i in ONTO:
            x = results[ONTO[i]] + F.pixel_shuffle(x, 2)
        results.append(x)
    return x


class Fastdvdnet(Network):
    """See `nets::Fastdvdnet`, its ends joined in a circle. Called with a video `[b, T, C, H, W]`, sides multiples of 4, and σ `[b]` on its scale.

    It has batch norm while it is trained, which [`weights`](Fastdvdnet.weights) fold into biases.
    """

    def __init__(self, channels, widths=(32, 64, 128), device="cpu", seed=0):
        super().__init__(device)
        (a, b, c), features = widths, 90
        sizes = [(3 * (channels + 1), features), (features, a), (a, b), (b, b), (b, b), (b, c), (c, c), (c, c), (c, c), (c, c)]
        sizes += [(c, 4 * b), (b, b), (b, b), (b, 4 * a), (a, a), (a, channels)]
        self.stats, self.training = {}, False
        generator = torch.Generator().manual_seed(seed)
        for stage in ("temp1", "temp2"):
            for i, ((name, _, hidden), (inputs, outputs)) in enumerate(zip(LAYERS, sizes)):
                weight, name = he(generator, outputs, inputs // 3 if i == 0 else inputs), f"{stage}.{name}"
                self.params[name + ".weight"] = weight if hidden else weight.zero_()
                if hidden:
                    self.params |= {name + ".gain": torch.ones(outputs), name + ".bias": torch.zeros(outputs)}
                    self.stats |= {name + ".mean": torch.zeros(outputs), name + ".variance": torch.ones(outputs)}
        self.params = {name: p.to(device).requires_grad_() for name, p in self.params.items()}
        self.stats = {name: value.to(device) for name, value in self.stats.items()}

    def __call__(self, video, sigma):
        b, t, c, h, w = video.shape
        if h % 4 or w % 4:
            raise ValueError(f"frames of {h}x{w} pixels: sides must be multiples of 4")
        noise = sigma.reshape(b, 1, 1, 1, 1).expand(b, t, 1, h, w)
        for stage in ("temp1.", "temp2."):
            seen = torch.cat([video.roll(1, 1), noise, video, noise, video.roll(-1, 1), noise], 2)
            seen = seen.reshape(b * t, -1, h, w).to(self.dtype, memory_format=torch.channels_last)
            stats = {name[len(stage) :]: value for name, value in self.stats.items() if name.startswith(stage)}
            found = fastdvdnet_block(self.named(stage), stats, seen, self.training)
            video = video - found.float().reshape(b, t, c, h, w)
        return video

    def compile(self):
        pass

    def weights(self):
        folded = {}
        for name, p in self.params.items():
            layer, kind = name.rsplit(".", 1)
            if layer + ".gain" not in self.params:
                folded[name] = p.detach()
            elif kind == "weight":
                gain = self.params[layer + ".gain"] / (self.stats[layer + ".variance"] + EPSILON).sqrt()
                folded[name] = (p * gain.reshape(-1, 1, 1, 1)).detach()
                folded[layer + ".bias"] = (self.params[layer + ".bias"] - gain * self.stats[layer + ".mean"]).detach()
        return folded
