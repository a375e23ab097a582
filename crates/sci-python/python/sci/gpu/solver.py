"""Accelerated GAP from a start by TV, on batches of gray videos or mosaics. Everything can be differentiated through."""

import torch
import torch.nn.functional as F

#: Color of the pixels at [0, 0], [0, 1], [1, 0], [1, 1]: 0 red, 1 green, 2 blue.
PATTERNS = {"rggb": (0, 1, 1, 2), "grbg": (1, 0, 2, 1), "gbrg": (1, 2, 0, 1), "bggr": (2, 1, 1, 0)}


def cfa_planes(pattern, height, width, device=None):
    """Where a sensor sees red, green and blue: `[3, H, W]` of 0 and 1."""
    if pattern not in PATTERNS:
        raise ValueError(f"pattern = {pattern!r} is not legal; legal: {', '.join(PATTERNS)}")
    planes = torch.zeros(3, height, width, device=device)
    for site, color in enumerate(PATTERNS[pattern]):
        planes[color, site // 2 :: 2, site % 2 :: 2] = 1
    return planes


def mosaic(rgb, cfa):
    """What a sensor sees of `[..., 3, H, W]`."""
    return (rgb * cfa).sum(-3)


def total_variation(x, weight=0.1, steps=4):
    """Chambolle's dual projection of every image of `[N, H, W]`, as `admm::Tv` with its five iterations, the last of which forms the result."""
    p0, p1 = torch.zeros_like(x), torch.zeros_like(x)
    for _ in range(steps):
        u = x + _divergence(p0, p1)
        g0 = F.pad(u[:, 1:] - u[:, :-1], (0, 0, 0, 1))
        g1 = F.pad(u[:, :, 1:] - u[:, :, :-1], (0, 1))
        # 1e-30: a root has no slope at 0.
        shrink = 1 / (1 + 0.25 / weight * (g0 * g0 + g1 * g1 + 1e-30).sqrt())
        p0, p1 = (p0 - 0.25 * g0) * shrink, (p1 - 0.25 * g1) * shrink
    return x + _divergence(p0, p1)


def _divergence(p0, p1):
    return F.pad(p0[:, :-1], (0, 0, 1, 0)) - p0 + F.pad(p1[:, :, :-1], (1, 0)) - p1


def tv_of_lattices(x, weight=0.1):
    """[`total_variation`] of each color of mosaics `[N, H, W]` by itself; sides are even."""
    n, h, w = x.shape
    parts = x.reshape(n, h // 2, 2, w // 2, 2).permute(0, 2, 4, 1, 3).reshape(4 * n, h // 2, w // 2)
    return total_variation(parts, weight).reshape(n, 2, 2, h // 2, w // 2).permute(0, 3, 1, 4, 2).reshape(n, h, w)


def demosaic(y, cfa):
    """Menon's demosaicing of `[N, H, W]`, `[N, 3, H, W]`: directional filtering, a posteriori decision, refinement (Menon 2007), as
    `sci_forward::bayer::Menon`."""
    is_red, is_green, is_blue = cfa > 0
    red_row = is_red.any(1, keepdim=True).expand_as(is_red)

    def at(x, dy, dx, outside="reflect"):
        p = F.pad(x[:, None], (2, 2, 2, 2), mode=outside)[:, 0]
        return p[:, 2 + dy : 2 + dy + x.shape[1], 2 + dx : 2 + dx + x.shape[2]]

    def beside(x):
        return 0.5 * (at(x, 0, -1) + at(x, 0, 1))

    def above(x):
        return 0.5 * (at(x, -1, 0) + at(x, 1, 0))

    greens = []
    for dy, dx in ((0, 1), (1, 0)):
        near, far = at(y, -dy, -dx) + y + at(y, dy, dx), at(y, -2 * dy, -2 * dx) + at(y, 2 * dy, 2 * dx)
        greens.append(torch.where(is_green, y, 0.5 * near - 0.25 * far))
    along_row = _along_row(y, greens, at)
    green = torch.where(along_row, *greens)

    # Red and blue at the green sites: the color of the row from beside, the other from above and below.
    own = torch.where(is_green, green + beside(y - green), y)
    other = green + above(y - green)
    red, blue = torch.where(red_row, own, other), torch.where(red_row, other, own)

    def mean_of_two(x):
        return torch.where(along_row, beside(x), above(x))

    def smooth(x):
        return (2 * mean_of_two(x) + x) / 3

    difference = mean_of_two(red - blue)
    red, blue = torch.where(is_blue, blue + difference, red), torch.where(is_red, red - difference, blue)
    green = torch.where(is_red, red - smooth(red - green), torch.where(is_blue, blue - smooth(blue - green), green))
    to_red, to_blue = red - green, blue - green
    red = torch.where(is_green, green + torch.where(red_row, beside(to_red), above(to_red)), red)
    blue = torch.where(is_green, green + torch.where(red_row, above(to_blue), beside(to_blue)), blue)
    difference = smooth(red - blue)
    red, blue = torch.where(is_blue, blue + difference, red), torch.where(is_red, red - difference, blue)
    return torch.stack([red, green, blue], 1)


def _along_row(y, greens, at):
    """Where the color difference changes less along the row than along the column."""
    with torch.no_grad():
        row, column = (y - green for green in greens)
        row, column = (row - at(row, 0, 2)).abs(), (column - at(column, 2, 0)).abs()
        # A change belongs to the site before it, hence the taps behind; one along the columns is the same, turned.
        taps = {(-2, 0): 1, (-2, -2): 1, (-1, -1): 1, (0, 0): 3, (0, -2): 3, (1, -1): 1, (2, 0): 1, (2, -2): 1}
        across = sum(share * at(row, dy, dx, "constant") for (dy, dx), share in taps.items())
        down = sum(share * at(column, dx, dy, "constant") for (dy, dx), share in taps.items())
        return down >= across


#: What `solve` calls.
KERNELS = {"demosaic": demosaic, "tv": total_variation, "tv_of_lattices": tv_of_lattices}


def compile_kernels():
    """Puts compiled ones in their place, for clips of one size."""
    for name, kernel in KERNELS.items():
        KERNELS[name] = torch.compile(kernel, dynamic=False)


@torch.no_grad()
def warm_start(masks, y, color=False, iterations=20, gamma=0.01):
    """ADMM with TV, of which the projection is kept, as `admm::WarmStart`: masks `[b, T, H, W]`, y `[b, H, W]`."""
    b, t, h, w = masks.shape
    inverse = 1 / ((masks * masks).sum(1) + gamma)
    prior = KERNELS["tv_of_lattices" if color else "tv"]
    theta, dual = masks * y[:, None], torch.zeros_like(masks)
    for k in range(iterations):
        if k > 0:
            z = x - dual
            theta = prior(z.reshape(b * t, h, w)).reshape(b, t, h, w).clamp(0, 1)
            dual = theta - z
        z = theta + dual
        x = z + masks * ((y - (masks * z).sum(1)) * inverse)[:, None]
    return x


def solve(network, masks, y, sigmas, cfa=None, start_iterations=20, skip_gradient=0):
    """The results `[b, T, C, H, W]` of one call of the network with each of `sigmas` (in 0..255 units), in accelerated GAP.

    As configs/gray/fast.toml: from TV (from y / ΣC without iterations), the video turned another way round in every call.

    :param network: called with a video `[b, T, C, H, W]` and a σ.
    :param masks: `[b, T, H, W]`, 0 where nothing is measured, as is `y`, `[b, H, W]`.
    :param cfa: [`cfa_planes`] of a color sensor.
    :param skip_gradient: calls at the beginning through which no gradient goes.
    """
    b, t, h, w = masks.shape
    gram = (masks * masks).sum(1)
    inverse = torch.where(gram > 0, 1 / gram.clamp(min=1e-12), torch.zeros_like(gram))
    if start_iterations > 0:
        v = warm_start(masks, y, cfa is not None, start_iterations)
    else:
        v = _mean(masks, y)[:, None].expand_as(masks)
    y1, results = y, []
    for k, sigma in enumerate(sigmas):
        with torch.set_grad_enabled(torch.is_grad_enabled() and k >= skip_gradient):
            missed = (masks * v).sum(1)
            y1 = y1 + (y - missed)
            x = v + masks * ((y1 - missed) * inverse)[:, None]
            if cfa is None:
                seen = x[:, :, None]
            else:
                seen = KERNELS["demosaic"](x.reshape(b * t, h, w), cfa).reshape(b, t, 3, h, w)
            axes = [axis for bit, axis in enumerate((4, 3, 1)) if k >> bit & 1]
            results.append(network(seen.flip(axes), sigma).flip(axes))
            v = results[-1][:, :, 0] if cfa is None else mosaic(results[-1], cfa)
    return results


def _mean(masks, y):
    """The still scene that fits y; pixels that no mask opens get the mean of the others."""
    opened = masks.sum(1)
    still = torch.where(opened > 0, y / opened.clamp(min=1e-12), torch.zeros_like(y))
    fill = still.sum((1, 2), keepdim=True) / (opened > 0).sum((1, 2), keepdim=True).clamp(min=1)
    return torch.where(opened > 0, still, fill.expand_as(still))
